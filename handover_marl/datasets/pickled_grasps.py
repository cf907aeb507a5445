"""Reading HandoverSim's grasp files, which are pickles, without trusting them.

An official file is a `.npy` with one pickled dict whose key `transforms` holds (n, 4, 4) gripper poses in the
object's frame. A pickle can run any code when it is loaded, so it is read as `plain_pickle` tells.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.pickled_arrays import ARRAY_NAMES, PickledArray
from handover_marl.datasets.plain_pickle import decoded, load_plain, refuse
from handover_marl.errors import DataFormatError, UnsafeFileError

_FARTHEST = 100.0


def _unpickle(stream: io.BytesIO) -> Any:
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    _, _, dtype = read_header(stream)
    if dtype.hasobject is False:
        refuse("it holds a plain array where a pickled dict belongs")
    content = load_plain(stream.read(), ARRAY_NAMES)
    content = content.value.item() if isinstance(content, PickledArray) and content.value is not None else content
    if not isinstance(content, dict):
        refuse(f"expected a pickled dict, found {type(content).__name__}")
    return content


def load_pickled_dict(path: Path) -> dict[str, Any]:
    """The dict inside an official `.npy` file, its byte keys turned to text and its array values to arrays.

    Raises:
        UnsafeFileError: The pickle holds something other than numpy arrays and plain values.
        DataFormatError: The file is no such file, or is damaged.
    """
    try:
        content = _unpickle(io.BytesIO(path.read_bytes()))
        return {
            decoded(key): value.value if isinstance(value, PickledArray) else value for key, value in content.items()
        }
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. "
            "Replace it by the original HandoverSim file."
        ) from None
    except Exception as error:
        raise DataFormatError(
            f"{path}: not a readable grasp file ({str(error) or type(error).__name__}). "
            "Copy it again from the HandoverSim data."
        ) from error


def unpickle_plain(data: bytes) -> dict[str, npt.NDArray[Any]] | npt.NDArray[Any]:
    """A pickled array, or the arrays in a pickled dict of arrays.

    Raises:
        DataFormatError: The pickle is something else, asks for more, or is damaged.
    """
    try:
        content = load_plain(data, ARRAY_NAMES)
        if isinstance(content, PickledArray) and content.value is not None:
            return content.value
        if not isinstance(content, dict):
            refuse(f"expected a dict, found {type(content).__name__}")
        return {decoded(key): value.value for key, value in content.items() if value.value is not None}
    except Exception as error:  # what damaged pickles raise has no end
        raise DataFormatError(f"no pickled dict of arrays ({str(error) or type(error).__name__})") from error


def load_grasps(path: Path) -> npt.NDArray[np.float64]:
    """The (n, 4, 4) gripper poses `object_from_gripper` of a grasp file (m), float64.

    Raises:
        UnsafeFileError: As `load_pickled_dict`.
        DataFormatError: The file is damaged or holds no such array.
    """
    content = load_pickled_dict(path)
    if "transforms" not in content:
        raise DataFormatError(f"{path}: no key 'transforms' among {sorted(content)}")
    transforms = content["transforms"]
    if not isinstance(transforms, np.ndarray) or transforms.dtype.kind not in "iuf":
        raise DataFormatError(f"{path}: 'transforms' is no array of numbers")
    transforms = transforms.astype(np.float64)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not np.isfinite(transforms).all():
        raise DataFormatError(
            f"{path}: 'transforms' must be finite numbers of shape (n, 4, 4), found shape {transforms.shape}"
        )
    if np.abs(transforms).max(initial=0.0) > _FARTHEST:
        raise DataFormatError(f"{path}: 'transforms' has numbers beyond {_FARTHEST:g}, which no pose in metres has")
    return transforms
