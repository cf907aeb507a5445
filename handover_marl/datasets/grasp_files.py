"""Reader of HandoverSim's grasp files.

A grasp file is a `.npy` with one pickled dict whose key `transforms` holds (n, 4, 4) gripper poses in the object's
frame.
"""

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.restricted_pickle import load_restricted
from handover_marl.errors import DataFormatError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_plain_file

_MAX_BYTES = 20_000_000  # official files have less than 1 MB


def load_grasps(path: Path) -> npt.NDArray[np.float64]:
    """Load the gripper poses (n, 4, 4) `object_from_gripper` (m) of a grasp file.

    Raises:
        UnsafeFileError: The pickle uses something other than arrays and plain values.
        DataFormatError: The file is damaged, or has no finite poses.
    """
    try:
        stream = io.BytesIO(read_plain_file(path, _MAX_BYTES))
        np.lib.format.read_magic(stream)
        np.lib.format.read_array_header_1_0(stream)
        content = load_restricted(stream.read())
        content = content.item() if isinstance(content, np.ndarray) else content
        # Files of Python 3 have bytes as keys.
        by_name = {key.decode() if isinstance(key, bytes) else key: value for key, value in content.items()}
        grasps: npt.NDArray[np.float64] = by_name["transforms"].astype(np.float64)
        if grasps.ndim != 3 or grasps.shape[1:] != (4, 4) or not np.isfinite(grasps).all():
            raise ValueError(f"'transforms' must be finite numbers of shape (n, 4, 4), got shape {grasps.shape}")
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. "
            "Replace it by the original HandoverSim file."
        ) from None
    except Exception as error:  # Damaged pickles raise exceptions of many types.
        raise DataFormatError(
            f"{path}: not a readable grasp file ({shorten_text(error)}). Copy it again from the HandoverSim data."
        ) from error
    return grasps
