"""Recordings and meshes for the tests of custom scenes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.config import TABLE_HEIGHT

PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
#: Position (m) and orientation (quaternion xyzw) of the wrist beside the box of `make_box`, in the object frame.
#: The fingers point to -y, the palm to +x.
WRIST_IN_OBJECT = (-0.055, 0.1, -0.02)
WRIST_ROTATION = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))


def make_box() -> trimesh.Trimesh:
    """Return a box of 5 x 5 x 16 cm."""
    return trimesh.creation.box((0.05, 0.05, 0.16))


def make_recording(rate: float = 60.0, duration: float = 3.0) -> dict[str, npt.NDArray[np.float64]]:
    """Return a recording in the world frame: a right hand lifts a box and holds it out.

    Keys: "time" (N,) in s, and the poses (N, 7) "object" and "wrist", xyz (m) and quaternion xyzw.
    """
    time = np.arange(round(duration * rate) + 1) / rate
    t = np.clip((time - 1.0) / 1.2, 0.0, 1.0)
    progress = (t**3 * (10.0 + t * (6.0 * t - 15.0)))[:, None]
    start, end = np.array([0.6, 0.25, TABLE_HEIGHT + 0.081]), np.array([0.6, 0.0, TABLE_HEIGHT + 0.3])
    positions = start + progress * (end - start)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    reach = (1.0 - np.clip(time / 0.6, 0.0, 1.0))[:, None] * [0.0, 0.25, 0.1]
    wrist = positions + WRIST_IN_OBJECT + reach
    turned = np.tile(WRIST_ROTATION, (len(time), 1))
    return {
        "time": time,
        "object": np.concatenate([positions, still], axis=1),
        "wrist": np.concatenate([wrist, turned], axis=1),
    }


def write_csv(path: Path, recording: Mapping[str, Any]) -> Path:
    """Write a recording, see `make_recording`, as a CSV file with empty cells for NaN; return the path."""
    columns = {"time": recording["time"]}
    for body, poses in recording.items():
        if body != "time":
            columns |= {f"{body}_{part}": column for part, column in zip(PARTS, np.transpose(poses), strict=True)}
    rows = [",".join(columns)]
    rows += [
        ",".join("" if np.isnan(value) else f"{value:.7g}" for value in row)
        for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n")
    return path
