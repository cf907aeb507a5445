"""Own scenes: a folder of a user's objects, motions and splits, and the data set that reads it.

`scene_file` defines the file `scenes.json`, `dataset` the data set "own:FOLDER". The builder of such folders is
`handover_marl.assets.building.own_scenes`.
"""

from handover_marl.datasets.own.dataset import OwnDataset, open_own_dataset
from handover_marl.datasets.own.scene_file import FORMAT_VERSION, OwnObject, OwnScene, SceneFile

__all__ = ["FORMAT_VERSION", "OwnDataset", "OwnObject", "OwnScene", "SceneFile", "open_own_dataset"]
