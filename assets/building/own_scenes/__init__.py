"""Builder of folders of custom scenes: `OwnScenes`. Needs the extras `assets` and `import`."""

from handover_marl.assets.building.own_scenes.builder import OwnScenes
from handover_marl.assets.building.own_scenes.motion_tables import MotionConfig
from handover_marl.assets.building.own_scenes.object_meshes import MeshConfig

__all__ = ["MeshConfig", "MotionConfig", "OwnScenes"]
