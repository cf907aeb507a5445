"""Custom scenes: a folder with a user's objects, motions and splits, and the data set `own:FOLDER` that reads it.

`scene_file` defines the file `scenes.json`, and `dataset` the data set. The package
`handover_marl.assets.building.custom_scenes` builds such folders.
"""

from handover_marl.datasets.custom.dataset import CustomDataset, open_custom_dataset
from handover_marl.datasets.custom.scene_file import FORMAT_VERSION, CustomObject, CustomScene, SceneFile

__all__ = ["FORMAT_VERSION", "CustomDataset", "CustomObject", "CustomScene", "SceneFile", "open_custom_dataset"]
