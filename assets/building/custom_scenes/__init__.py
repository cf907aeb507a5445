"""Creation of folders of custom scenes with `CustomSceneFolder`. Needs the extras `assets` and `import`."""

from handover_marl.execution.options import require_modules

require_modules("creation of custom scenes", "assets,import", "trimesh")

# ruff: noqa: E402
from handover_marl.assets.building.custom_scenes.builder import CustomSceneFolder
from handover_marl.assets.building.custom_scenes.motion_tables import MotionConfig
from handover_marl.assets.building.custom_scenes.object_meshes import MeshConfig

__all__ = ["CustomSceneFolder", "MeshConfig", "MotionConfig"]
