"""Handover scenes: DexYCB recordings in HandoverSim's folder layout, or generated ones.

`open_dataset` returns a data set by name. DexYCB is imported from its authors' files by
`handover_marl.datasets.dexycb.importer`.
"""

import os

from handover_marl.datasets.dataset import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.errors import DataNotFoundError, OptionError, check_name
from handover_marl.execution.options import check_path
from handover_marl.geometry.panda import PANDA

#: Environment variable with the data folder, for calls without the argument `data_dir`.
DATA_DIR_VARIABLE = "HANDOVER_MARL_DATA"

#: Accepted names. "auto" is DexYCB if a data folder is given or set, else the synthetic scenes.
DATASETS = ("auto", "synthetic", "dexycb")

#: Names of the data sets in reports.
DATASET_TITLES = {"dexycb": "DexYCB", "synthetic": "synthetic scenes"}

__all__ = ["DATASETS", "DATASET_TITLES", "DATA_DIR_VARIABLE", "Dataset", "OfficialDataset", "open_dataset"]


def open_dataset(dataset: str = "auto", data_dir: str | os.PathLike[str] | None = None, robot: str = PANDA) -> Dataset:
    """Return a data set by name.

    Args:
        dataset: One of `DATASETS`.
        data_dir: Folder in HandoverSim's layout; default: the one in `HANDOVER_MARL_DATA`.
        robot: Variant of the Panda, "panda" or "panda_camera".

    Raises:
        UnknownNameError: The data set or the robot does not exist.
        OptionError: A data folder is given for the synthetic scenes, or is not a path.
        DataNotFoundError: DexYCB is requested without a data folder, or the folder is missing.
    """
    check_name("dataset", dataset, DATASETS)
    if dataset == "synthetic" and data_dir:
        raise OptionError(f"synthetic scenes need no data folder, but data_dir is {data_dir}; leave one of them out")
    given = None if data_dir is None else check_path("data_dir", data_dir)
    chosen = given or os.environ.get(DATA_DIR_VARIABLE)
    if dataset == "synthetic" or (dataset == "auto" and not chosen):
        # DexYCB needs none of the generator's imports, which take long.
        from handover_marl.datasets.synthetic import SyntheticDataset

        return SyntheticDataset(robot)
    if not chosen:
        raise DataNotFoundError(
            "no data folder given. Set data_dir=, --data-dir or HANDOVER_MARL_DATA to a folder in HandoverSim's "
            "layout (dex-ycb-cache/ and assets/), or take the synthetic scenes (dataset='synthetic')."
        )
    try:
        folder = check_path("data_dir", chosen).resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise DataNotFoundError(f"data folder {str(chosen)[:200]!r} cannot be used ({error})") from error
    return OfficialDataset(folder, robot)
