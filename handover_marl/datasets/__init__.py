"""Where scenes come from: the official layout on disk, and the official splits."""

import os
from pathlib import Path

from handover_marl.datasets.base import Dataset
from handover_marl.datasets.official import OfficialDataset
from handover_marl.errors import DataNotFoundError

#: Environment variable that names the data folder when no argument does.
DATA_VARIABLE = "HANDOVER_MARL_DATA"

__all__ = ["DATA_VARIABLE", "Dataset", "OfficialDataset", "open_dataset"]


def open_dataset(data_dir: str | os.PathLike[str] | None = None) -> Dataset:
    """The dataset in `data_dir`, or in the folder that `HANDOVER_MARL_DATA` names.

    Raises:
        DataNotFoundError: No folder was given, or it is not there.
    """
    chosen = data_dir or os.environ.get(DATA_VARIABLE)
    if not chosen:
        raise DataNotFoundError(
            "no data folder given. Set data_dir=, --data-dir or HANDOVER_MARL_DATA to a folder in HandoverSim's "
            "layout (dex-ycb-cache/ and assets/)."
        )
    return OfficialDataset(Path(chosen).expanduser().resolve())
