"""A scene's two files in HandoverSim's cache: meta_NNN.json and pose_NNN.npz."""

import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import DataFormatError
from handover_marl.files import create_exclusively, holds, read_arrays

Float32 = npt.NDArray[np.float32]

#: Folder of these files within a data folder.
CACHE_FOLDER = "dex-ycb-cache"
_LARGEST = 500_000_000  # bytes of a scene's motion, unpacked


@dataclass(frozen=True, eq=False)
class CachedScene:
    """What the cache holds of a scene.

    Attributes:
        scene_id: Number of the scene.
        meta: Its meta file, keys in the official order.
        pose_y: (T, n, 6) float32 motion of the objects at 1 kHz in the tag's frame (m, rad).
        pose_m: (T, 1, 51) float32 motion of the hand.
    """

    scene_id: int
    meta: dict[str, Any]
    pose_y: Float32
    pose_m: Float32


def write_scene(scene: CachedScene, cache: Path) -> None:
    """Write a scene's files; those that are there already stay, and must have the same content.

    Args:
        scene: The scene.
        cache: The cache's folder, which exists.

    Raises:
        DataFormatError: A file is there with other content.
        ResultsError: A file cannot be written.
    """
    arrays = {"pose_y": np.ascontiguousarray(scene.pose_y), "pose_m": np.ascontiguousarray(scene.pose_m)}
    pose = cache / f"pose_{scene.scene_id:03d}.npz"
    if not os.path.lexists(pose):
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        create_exclusively(pose, stream.getvalue())
    _check_pose(pose, arrays)
    # The meta file comes last: with it the scene is complete.
    meta, text = cache / f"meta_{scene.scene_id:03d}.json", json.dumps(scene.meta).encode()
    create_exclusively(meta, text)
    _check_meta(meta, text)


def _check_pose(path: Path, expected: dict[str, Float32]) -> None:
    # Archives hold times and depend on the compressor, so contents are compared.
    try:
        found = read_arrays(path, tuple(expected), _LARGEST)
    except Exception as error:  # what damaged bytes raise has no end
        raise _differs(path) from error
    for name, array in expected.items():
        same = found[name].dtype == array.dtype and found[name].shape == array.shape
        # As bytes, since 0.0 equals -0.0.
        if not same or found[name].tobytes() != array.tobytes():
            raise _differs(path)


def _check_meta(path: Path, expected: bytes) -> None:
    try:
        same = holds(path, expected)
    except OSError as error:
        raise _differs(path) from error
    if not same:
        raise _differs(path)


def _differs(path: Path) -> DataFormatError:
    return DataFormatError(
        f"{path} is there already, but is not what this recording gives; remove it to have it written, or choose "
        "another folder"
    )
