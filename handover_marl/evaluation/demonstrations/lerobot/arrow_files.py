"""Parquet files and videos in memory; pyarrow and imageio-ffmpeg are optional dependencies."""

import importlib
import io
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.execution.options import require_modules

# H.264 that is equal on every run: one thread, no encoder's name and date. Every second frame is a keyframe, as in
# LeRobot's own videos, for random access; without bidirectional frames, times are exact multiples of 1 / fps.
_ENCODER_OPTIONS = "-crf 18 -g 2 -bf 0 -threads 1 -fflags +bitexact -flags:v +bitexact -movflags +faststart"


def require_lerobot_packages() -> None:
    """Check that the packages that write LeRobot's format are installed.

    Raises:
        OptionError: A package is not installed.
    """
    require_modules("format='lerobot'", "lerobot", "pyarrow", "imageio_ffmpeg")


def make_table(columns: Mapping[str, npt.NDArray[Any]]) -> Any:
    """Return a `pyarrow.Table` of arrays (T, ...); arrays (T,) and (T, 1) become columns of numbers.

    Arrays (T, n) become lists of fixed size, others nested lists, as LeRobot's reader expects.
    """
    arrow = _import("pyarrow")
    return arrow.table({name: _make_array(arrow, values) for name, values in columns.items()})


def make_table_of_rows(rows: list[dict[str, Any]]) -> Any:
    """Return a `pyarrow.Table` of dictionaries with equal keys."""
    return _import("pyarrow").Table.from_pylist(rows)


def encode_table(table: Any) -> bytes:
    """Return the content of a Parquet file; equal tables have equal content."""
    stream = io.BytesIO()
    parquet = _import("pyarrow.parquet")
    # Pages have checksums, which reveal damage.
    parquet.write_table(table, stream, compression="zstd", use_dictionary=False, write_page_checksum=True)
    return stream.getvalue()


def decode_table(content: bytes) -> Any:
    """Return the `pyarrow.Table` of a Parquet file.

    Raises:
        Exception: The file is damaged; pyarrow raises errors of several types.
    """
    return _import("pyarrow.parquet").read_table(io.BytesIO(content), page_checksum_verification=True)


def encode_video(frames: npt.NDArray[np.uint8], fps: int) -> bytes:
    """Return the content of an MP4 file (H.264, lossy); equal frames have equal content.

    Args:
        frames: (T, height, width, 3) colours; height and width are multiples of 16.
        fps: Frames per second.
    """
    size = frames.shape[2], frames.shape[1]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        options = {"codec": "libx264", "quality": None, "output_params": _ENCODER_OPTIONS.split()}
        stream = _import("imageio_ffmpeg").write_frames(path, size, fps=fps, **options)
        stream.send(None)
        for frame in frames:
            stream.send(np.ascontiguousarray(frame))
        stream.close()
        return path.read_bytes()


def _make_array(arrow: ModuleType, values: npt.NDArray[Any]) -> Any:
    array = arrow.array(values.reshape(-1))
    sizes = values.shape[1:]
    if sizes in ((), (1,)):
        return array
    if len(sizes) == 1:
        return arrow.FixedSizeListArray.from_arrays(array, sizes[0])
    for size in reversed(sizes):
        offsets = np.arange(0, len(array) + 1, size, dtype=np.int32)
        array = arrow.ListArray.from_arrays(offsets, array)
    return array


def _import(name: str) -> ModuleType:
    require_lerobot_packages()
    return importlib.import_module(name)
