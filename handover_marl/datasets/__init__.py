"""Where scenes come from: DexYCB in the official layout on disk, or generated ones; and the official splits."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handover_marl.datasets.dataset import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.errors import DataNotFoundError, OptionError, UnknownNameError
from handover_marl.models.panda import PANDA

if TYPE_CHECKING:
    from handover_marl.datasets.importing.import_dexycb import import_dexycb
    from handover_marl.datasets.importing.imported import Imported

#: Environment variable that names the data folder when no argument does.
DATA_VARIABLE = "HANDOVER_MARL_DATA"

#: What can be asked for. "auto" takes DexYCB when a data folder is given or set, else the generated scenes.
DATASETS = ("auto", "synthetic", "dexycb")

#: How they are called in words.
DATASET_TITLES = {"dexycb": "DexYCB", "synthetic": "synthetic scenes"}

__all__ = [
    "DATASETS",
    "DATASET_TITLES",
    "DATA_VARIABLE",
    "Dataset",
    "Imported",
    "OfficialDataset",
    "import_dexycb",
    "open_dataset",
]


def __getattr__(name: str) -> Any:
    # Only for who imports data, since it pulls in what nobody else needs.
    if name in ("Imported", "import_dexycb"):
        from handover_marl.datasets.importing import import_dexycb, imported

        return getattr(imported if name == "Imported" else import_dexycb, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def open_dataset(dataset: str = "auto", data_dir: str | os.PathLike[str] | None = None, robot: str = PANDA) -> Dataset:
    """A dataset by name.

    Args:
        dataset: One of `DATASETS`.
        data_dir: Folder in HandoverSim's layout; default: the one that `HANDOVER_MARL_DATA` names.
        robot: Which Panda stands in the scenes, "panda" or "panda_camera".

    Raises:
        UnknownNameError: No such dataset or robot.
        OptionError: A data folder was given for the synthetic scenes, which have none.
        DataNotFoundError: DexYCB was asked for without a data folder, or the folder is not there.
    """
    if dataset not in DATASETS:
        raise UnknownNameError("dataset", dataset, DATASETS)
    if dataset == "synthetic" and data_dir:
        raise OptionError(f"synthetic scenes need no data folder, but data_dir is {data_dir}; leave one of them out")
    if data_dir is not None and not isinstance(data_dir, (str, os.PathLike)):
        raise OptionError(f"data_dir={data_dir!r} must be a path")
    chosen = data_dir or os.environ.get(DATA_VARIABLE)
    if dataset == "synthetic" or (dataset == "auto" and not chosen):
        # Only now, because it pulls in what DexYCB does not need.
        from handover_marl.datasets.synthetic import SyntheticDataset

        return SyntheticDataset(robot)
    if not chosen:
        raise DataNotFoundError(
            "no data folder given. Set data_dir=, --data-dir or HANDOVER_MARL_DATA to a folder in HandoverSim's "
            "layout (dex-ycb-cache/ and assets/), or take the synthetic scenes (dataset='synthetic')."
        )
    try:
        folder = Path(chosen).expanduser().resolve()
    except (OSError, ValueError, RuntimeError) as error:
        raise DataNotFoundError(f"data folder {str(chosen)[:200]!r} cannot be ({error})") from error
    return OfficialDataset(folder, robot)
