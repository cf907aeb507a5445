"""Reading HandoverSim's grasp files, which are pickles, without trusting them.

An official file is a `.npy` with one pickled dict whose key `transforms` holds (n, 4, 4) gripper poses in the
object's frame. A pickle can run any code when it is loaded, so only numpy's own array builders are admitted.
"""

import io
import pickle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError, UnsafeFileError


def _encode_latin1(text: str, encoding: str) -> bytes:
    # Protocol-2 pickles store bytes as latin-1 text and name codecs.encode to turn them back.
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"codec {encoding!r} is not admitted")
    return text.encode("latin1")


def _reconstruct(kind: type, shape: tuple[int, ...], dtype: Any) -> npt.NDArray[Any]:
    # numpy's own _reconstruct takes any class; here an array can only be an array.
    return np.empty(shape, dtype)


def _from_buffer(
    buffer: bytes, dtype: np.dtype[Any], shape: tuple[int, ...], order: Literal["C", "F"], *_: object
) -> npt.NDArray[Any]:
    # Stands in for numpy's private function of protocol-5 pickles; numpy refuses object arrays here.
    return np.frombuffer(buffer, dtype=dtype).reshape(shape, order=order)


_ADMITTED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    ("_codecs", "encode"): _encode_latin1,
}


class _ArrayUnpickler(pickle.Unpickler):
    """An unpickler for plain containers, numbers, text and numpy arrays; nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ADMITTED[module, name]
        except KeyError:
            raise UnsafeFileError(f"asks for {module}.{name}") from None


def load_pickled_dict(path: Path) -> dict[str, Any]:
    """The dict inside an official `.npy` file, its byte keys turned to text.

    Raises:
        UnsafeFileError: The pickle holds something other than numpy arrays and plain values.
        DataFormatError: The file is no such file, or is damaged.
    """
    try:
        stream = io.BytesIO(path.read_bytes())
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        _, _, dtype = read_header(stream)
        if dtype.hasobject is False:
            raise DataFormatError("it holds a plain array where a pickled dict belongs")  # noqa: TRY301
        content = _ArrayUnpickler(stream, encoding="bytes").load()
        content = content.item() if isinstance(content, np.ndarray) else content
    except UnsafeFileError as error:
        raise UnsafeFileError(
            f"{path}: refused to load, the pickle {error} and may run foreign code. "
            "Replace it by the original HandoverSim file."
        ) from None
    except Exception as error:
        raise DataFormatError(
            f"{path}: not a readable grasp file ({error or type(error).__name__}). "
            "Copy it again from the HandoverSim data."
        ) from error
    if not isinstance(content, dict):
        raise DataFormatError(f"{path}: expected a pickled dict, found {type(content).__name__}")
    return {key.decode() if isinstance(key, bytes) else key: value for key, value in content.items()}


def load_grasps(path: Path) -> npt.NDArray[np.float64]:
    """The (n, 4, 4) gripper poses `object_from_gripper` of a grasp file (m), float64.

    Raises:
        UnsafeFileError: As `load_pickled_dict`.
        DataFormatError: The file is damaged or holds no such array.
    """
    content = load_pickled_dict(path)
    if "transforms" not in content:
        raise DataFormatError(f"{path}: no key 'transforms' among {sorted(map(str, content))}")
    try:
        transforms = np.asarray(content["transforms"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataFormatError(f"{path}: 'transforms' is not numeric ({error})") from error
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not np.isfinite(transforms).all():
        raise DataFormatError(
            f"{path}: 'transforms' must be finite numbers of shape (n, 4, 4), found shape {transforms.shape}"
        )
    return transforms
