"""Handover scenes: DexYCB recordings in HandoverSim's folder layout, or generated ones.

`open_dataset` returns a data set by name. DexYCB is imported from its authors' files by
`handover_marl.datasets.dexycb.importer`.
"""

import os

from handover_marl.datasets.dataset import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.datasets.registry import DATA_DIR_VARIABLE, split_dataset_name
from handover_marl.execution.options import check_path
from handover_marl.geometry.panda import PANDA

#: Name of DexYCB if a data folder is given or set, else of the synthetic scenes.
AUTO = "auto"

__all__ = ["AUTO", "DATA_DIR_VARIABLE", "Dataset", "OfficialDataset", "open_dataset"]


def open_dataset(dataset: str = AUTO, data_dir: str | os.PathLike[str] | None = None, robot: str = PANDA) -> Dataset:
    """Return a data set by name.

    Args:
        dataset: "synthetic", "dexycb", another kind of `handover_marl.datasets.registry.KINDS`, or "auto":
            DexYCB if a data folder is given or set, else the synthetic scenes.
        data_dir: Folder of the data; default for DexYCB: the one in `HANDOVER_MARL_DATA`.
        robot: Variant of the Panda, "panda" or "panda_camera".

    Raises:
        UnknownNameError: The data set or the robot does not exist.
        OptionError: A data folder is given for the synthetic scenes, or is not a path.
        DataNotFoundError: DexYCB is requested without a data folder, or the folder is missing.
    """
    given = None if data_dir is None else str(check_path("data_dir", data_dir))
    if dataset == AUTO:
        dataset = "dexycb" if given or os.environ.get(DATA_DIR_VARIABLE) else "synthetic"
    kind, argument = split_dataset_name(dataset)
    return kind.open_dataset(argument, given, robot)
