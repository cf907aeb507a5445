"""Tables of recorded poses: CSV and NPZ files at any rate, and their trajectories at 1 kHz.

A CSV file has one header line with the columns `time`, `object_x`, `object_y`, `object_z`, `object_qx`, `object_qy`,
`object_qz`, `object_qw`, the same for `wrist` and for every other object by its class name, and optionally
`finger_0` to `finger_44`. An NPZ file has the arrays `time` (T,), `object` (T, 7), `wrist` (T, 7), one array (T, 7)
for each other object by its class name, and `fingers` (T, 45). Poses are position and quaternion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.assets.hand_model import HandGeometry
from handover_marl.config import HAND_DOF, TABLE_HEIGHT, TIME_STEP
from handover_marl.datasets.custom.ranges import (
    DURATION,
    MAX_DISTANCE,
    MAX_FINGER_ANGLE,
    MAX_NORM_ERROR,
    MAX_SPEED,
    MAX_TURN_SPEED,
)
from handover_marl.datasets.synthetic.resampling import resample_fingers, resample_poses
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, check_name
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.geometry.poses import compose

Array = npt.NDArray[np.float64]

OBJECT, WRIST, TIME = "object", "wrist", "time"
N_FINGER_ANGLES: Final = 45
#: Frames of recorded poses: the world of the simulation, and the table's frame of DexYCB.
FRAMES: Final = ("world", "table")
#: Orders of quaternions, and forms of finger angles: intrinsic XYZ Euler angles or rotation vectors of MANO.
QUATERNIONS, FINGER_FORMS = ("xyzw", "wxyz"), ("euler", "rotvec")
_LENGTHS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_TIMES: Final = {"s": 1.0, "ms": 0.001}
_PARTS: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
_MAX_BYTES = 200_000_000
_MAX_FRAME_DISTANCE = 100.0  # m


@dataclass(frozen=True)
class MotionConfig:
    """Frames and units of a table of recorded poses.

    Attributes:
        frame: "world" (origin below the table, z up, the robot's base at (0.61, -0.50, 0.875) m), "table" (the
            same axes with the origin at the height of the table's surface), or the pose of the recording's frame in
            the world: seven numbers, position (m) and quaternion xyzw.
        length: Unit of positions: m, cm or mm.
        time: Unit of times: s or ms.
        quaternion: Order of quaternions in NPZ files: xyzw or wxyz; CSV columns have names.
        fingers: Form of finger angles (rad): "euler" (intrinsic XYZ) or "rotvec" (rotation vectors, as in MANO).
        max_gap: Largest gap (s) that is filled by interpolation.

    Raises:
        UnknownNameError: A name does not exist.
        OptionError: The frame is no pose, or `max_gap` is out of range.
    """

    frame: str | tuple[float, ...] = "world"
    length: str = "m"
    time: str = "s"
    quaternion: str = "xyzw"
    fingers: str = "euler"
    max_gap: float = 0.2

    def __post_init__(self) -> None:
        check_name("length", self.length, _LENGTHS)
        check_name("time", self.time, _TIMES)
        check_name("quaternion", self.quaternion, QUATERNIONS)
        check_name("fingers", self.fingers, FINGER_FORMS)
        if isinstance(self.frame, str):
            check_name("frame", self.frame, FRAMES)
        else:
            pose = np.asarray(self.frame, dtype=np.float64)
            if (
                pose.shape != (7,)
                or not np.isfinite(pose).all()
                or np.linalg.norm(pose[:3]) > _MAX_FRAME_DISTANCE
                or abs(np.linalg.norm(pose[3:]) - 1.0) > MAX_NORM_ERROR
            ):
                raise OptionError(
                    f"frame must be 'world', 'table' or seven numbers, position (within {_MAX_FRAME_DISTANCE:g} m) and "
                    f"unit quaternion xyzw, got {self.frame!r}"
                )
            object.__setattr__(self, "frame", tuple(map(float, pose)))
        if not isinstance(self.max_gap, (int, float)) or not 0.0 <= self.max_gap <= 2.0:
            raise OptionError(f"max_gap must be a time from 0 to 2 s, got {self.max_gap!r}")

    @property
    def world_from_frame(self) -> Array:
        """Pose (7,) of the recording's frame in the world."""
        if self.frame == "world":
            return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        if self.frame == "table":
            return np.array([0.0, 0.0, TABLE_HEIGHT, 0.0, 0.0, 0.0, 1.0])
        return np.array(self.frame, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class MotionTable:
    """Recorded poses in the world frame.

    Attributes:
        time: (T,) times from 0 (s), ascending.
        bodies: Poses (T, 7) of `object` and of the other objects by class name: position (m), quaternion xyzw.
        wrist: Poses (n, 7) of the wrist in the rows of `wrist_rows`, or None without a wrist.
        wrist_rows: First row with the wrist, and the row after the last.
        fingers: (n, 45) finger joint angles (rad, intrinsic XYZ Euler angles) in these rows, or None.
        repairs: Changes that were made to the recording.
    """

    time: Array
    bodies: Mapping[str, Array]
    wrist: Array | None
    wrist_rows: tuple[int, int]
    fingers: Array | None
    repairs: tuple[str, ...]


def read_motion_table(source: "str | Path | Mapping[str, npt.ArrayLike]", config: MotionConfig) -> MotionTable:
    """Read recorded poses from a CSV or NPZ file, or from arrays with the names of an NPZ file.

    Raises:
        DataNotFoundError: The file does not exist.
        DataFormatError: A column is missing or malformed; the error names column and row.
    """
    if isinstance(source, Mapping):
        name, arrays = "the motion", dict(source)
    else:
        path = Path(source).expanduser()
        name = str(path)
        arrays = _read_file(path)
    return _TableReader(name, config, isinstance(source, (str, Path)) and name.lower().endswith(".csv")).read(arrays)


def _read_file(path: Path) -> dict[str, Any]:
    if path.suffix.lower() not in (".csv", ".npz"):
        raise DataFormatError(f"{path}: a motion must be a .csv or .npz file, got {path.suffix!r}; convert it")
    try:
        data = read_plain_file(path, _MAX_BYTES)
    except FileNotFoundError:
        raise DataNotFoundError(f"motion file {path} does not exist; give the path of a .csv or .npz file") from None
    except (OSError, ValueError) as error:
        raise DataFormatError(f"{path}: cannot be read ({error}); give a .csv or .npz file") from error
    if path.suffix.lower() == ".csv":
        return _parse_csv(path, data)
    try:
        return dict(read_arrays(data, largest=_MAX_BYTES))
    except Exception as error:  # NumPy and zipfile raise many types on damaged files
        raise DataFormatError(f"{path}: not a readable .npz file ({shorten_text(error)}); write it again") from error


def _parse_csv(path: Path, data: bytes) -> dict[str, Any]:
    """Return the arrays of a CSV file; empty cells are NaN."""
    try:
        lines = [line for line in data.decode("utf-8-sig").splitlines() if line.strip() and not line.startswith("#")]
        header = [cell.strip() for cell in lines[0].split(",")]
        if len(lines) < 2:
            raise ValueError("it has no rows")
        values = np.loadtxt(
            lines[1:], delimiter=",", ndmin=2, encoding="utf-8", converters=lambda cell: float(cell.strip() or "nan")
        )
        columns = dict(zip(header, values.T, strict=True))
    except (ValueError, IndexError) as error:
        raise DataFormatError(f"{path}: not a CSV file of numbers ({shorten_text(error)}); export it again") from error
    if len(columns) < len(header):
        twice = next(cell for cell in header if header.count(cell) > 1)
        raise DataFormatError(f"{path}: column {shorten_text(twice)!r} must be there once, got it twice; rename one")

    def take(names: Sequence[str]) -> Array:
        missing = [name for name in names if name not in columns]
        if missing:
            raise DataFormatError(
                f"{path}: column {shorten_text(missing[0])!r} is missing; it belongs to {', '.join(names[:7])}"
            )
        return np.stack([columns.pop(name) for name in names], axis=1)

    arrays: dict[str, Any] = {TIME: columns.pop(TIME)} if TIME in columns else {}
    if any(name.startswith("finger_") for name in columns):
        arrays["fingers"] = take([f"finger_{number}" for number in range(N_FINGER_ANGLES)])
    while columns:
        body = next(iter(columns)).rpartition("_")[0]
        arrays[body] = take([f"{body}_{part}" for part in _PARTS])
    return arrays


class _TableReader:
    """Checks and repairs of recorded poses.

    Args:
        name: Name of the recording, for errors.
        config: Frames and units.
        is_csv: Whether quaternions are xyzw whatever the configuration says.
    """

    def __init__(self, name: str, config: MotionConfig, is_csv: bool) -> None:
        self._name, self._config, self._is_csv = name, config, is_csv
        self._repairs: list[str] = []

    def read(self, arrays: Mapping[str, Any]) -> MotionTable:
        """Return the checked poses in the world frame."""
        for key in (TIME, OBJECT):
            if key not in arrays:
                raise self._make_error(f"{key} is missing; a motion has {TIME}, {OBJECT} and optionally {WRIST}")
        numbers = {key: self._read_numbers(key, value) for key, value in arrays.items()}
        time = self._read_time(numbers.pop(TIME))
        fingers = numbers.pop("fingers", None)
        bodies = {key: self._read_poses(key, poses, time) for key, poses in numbers.items() if key != WRIST}
        wrist, rows = None, (0, 0)
        if WRIST in numbers:
            rows = self._find_wrist_rows(numbers[WRIST], time)
            wrist = self._read_poses(WRIST, numbers[WRIST], time, rows)
        angles = None
        if fingers is not None:
            if wrist is None:
                raise self._make_error("fingers need a wrist; add its poses or leave the fingers out")
            angles = self._read_fingers(fingers, time, rows)
        return MotionTable(time, bodies, wrist, rows, angles, tuple(self._repairs))

    def _make_error(self, text: str) -> DataFormatError:
        return DataFormatError(f"{self._name}: {text}")

    def _read_numbers(self, key: str, value: Any) -> Array:
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "fiu":
                raise TypeError(f"got {array.dtype}")
            return array.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise self._make_error(
                f"{shorten_text(key)} must be an array of numbers ({error}); write it again"
            ) from None

    def _read_time(self, time: Array) -> Array:
        if time.ndim != 1 or len(time) < 2:
            raise self._make_error(f"time must have shape (T,) with at least 2 rows, got shape {time.shape}")
        if not np.isfinite(time).all():
            row = int(np.flatnonzero(~np.isfinite(time))[0])
            raise self._make_error(f"time must be finite, got {time[row]} in row {row + 1}; remove the row")
        seconds: Array = (time - time[0]) * _TIMES[self._config.time]
        steps = np.diff(seconds)
        if (steps <= 0.0).any():
            row = int(np.flatnonzero(steps <= 0.0)[0]) + 1
            raise self._make_error(
                f"time must increase, got {time[row]:g} in row {row + 1} after {time[row - 1]:g}; sort the rows and "
                "remove repeated ones"
            )
        if not DURATION[0] <= seconds[-1] <= DURATION[1]:
            raise self._make_error(
                f"a motion must last {DURATION[0]} to {DURATION[1]:g} s, got {seconds[-1]:.4g} s; cut it, or pass "
                "the unit of time (time='ms')"
            )
        if steps.max() > max(self._config.max_gap, 1e-9):
            row = int(np.argmax(steps))
            raise self._make_error(
                f"the gap between rows {row + 1} and {row + 2} must be at most {self._config.max_gap:g} s (max_gap), "
                f"got {steps[row]:.3g} s; record again or raise max_gap"
            )
        median = float(np.median(steps))
        if steps.max() > 1.5 * median:
            self._repairs.append(f"gaps of up to {steps.max():.3g} s between rows interpolated")
        return seconds

    def _find_wrist_rows(self, poses: Array, time: Array) -> tuple[int, int]:
        self._check_shape(WRIST, poses, time)
        present = np.flatnonzero(np.isfinite(poses).all(axis=1))
        if len(present) < 2:
            raise self._make_error("wrist must have poses in at least 2 rows; leave it out for a scene without a hand")
        return int(present[0]), int(present[-1]) + 1

    def _check_shape(self, key: str, poses: Array, time: Array) -> None:
        if poses.shape != (len(time), 7):
            raise self._make_error(f"{shorten_text(key)} must have shape ({len(time)}, 7), got {poses.shape}")

    def _read_poses(self, key: str, poses: Array, time: Array, rows: tuple[int, int] | None = None) -> Array:
        """Return the poses (n, 7) of a body in some rows, in the world frame, without gaps."""
        self._check_shape(key, poses, time)
        first, end = rows or (0, len(time))
        poses = poses[first:end].copy()
        if not self._is_csv and self._config.quaternion == "wxyz":
            poses[:, 3:] = np.roll(poses[:, 3:], -1, axis=1)
        poses[:, :3] *= _LENGTHS[self._config.length]
        poses = self._fill_gaps(key, poses, time[first:end], first)
        norms = np.linalg.norm(poses[:, 3:], axis=1)
        wrong = np.flatnonzero(np.abs(norms - 1.0) > MAX_NORM_ERROR)
        if len(wrong):
            raise self._make_error(
                f"the quaternion of {key} must have norm 1, got {norms[wrong[0]]:.4g} in row {first + wrong[0] + 1}; "
                "check the columns and their order"
            )
        poses[:, 3:] /= norms[:, None]
        self._check_speed(key, poses, time[first:end], first)
        world: Array = compose(self._config.world_from_frame, poses)
        distances = np.linalg.norm(world[:, :3], axis=1)
        if distances.max() > MAX_DISTANCE:
            units = [unit for unit in _LENGTHS if unit != self._config.length]
            raise self._make_error(
                f"{key} must be within {MAX_DISTANCE:g} m of the world's origin, got a distance of "
                f"{distances.max():.4g} m in row {first + int(np.argmax(distances)) + 1}; if it is in {units[-1]}, "
                f"pass length={units[-1]!r}, or pass the frame"
            )
        return world

    def _fill_gaps(self, key: str, poses: Array, time: Array, first: int) -> Array:
        """Interpolate rows with missing values that lie between valid rows."""
        if np.isinf(poses).any():
            row = int(np.flatnonzero(np.isinf(poses).any(axis=1))[0])
            raise self._make_error(f"{key} must be finite, got infinity in row {first + row + 1}; record it again")
        valid = np.flatnonzero(~np.isnan(poses).any(axis=1))
        missing = np.flatnonzero(np.isnan(poses).any(axis=1))
        if not len(missing):
            return poses
        if len(valid) < 2 or valid[0] > 0 or valid[-1] < len(poses) - 1:
            raise self._make_error(
                f"{key} must have poses in the first and the last row, got none in row {first + int(missing[0]) + 1}; "
                "cut the recording"
            )
        gaps = np.diff(time[valid])
        longest = int(np.argmax(np.where(np.diff(valid) > 1, gaps, 0.0)))
        if gaps[longest] > self._config.max_gap:
            raise self._make_error(
                f"{key} has no pose from row {first + int(valid[longest]) + 2} to {first + int(valid[longest + 1])}, "
                f"for {gaps[longest]:.3g} s; gaps must be at most max_gap={self._config.max_gap:g} s. Record it again "
                "or raise max_gap"
            )
        filled: Array = poses.copy()
        for column in range(3):
            filled[missing, column] = np.interp(time[missing], time[valid], poses[valid, column])
        turns = Slerp(time[valid], Rotation.from_quat(poses[valid, 3:]))
        filled[missing, 3:] = turns(time[missing]).as_quat()
        self._repairs.append(f"{key}: {len(missing)} rows without a pose interpolated")
        return filled

    def _check_speed(self, key: str, poses: Array, time: Array, first: int) -> None:
        steps = np.diff(time)
        speeds = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) / steps
        turns = np.abs(np.einsum("ij,ij->i", poses[1:, 3:], poses[:-1, 3:]))
        turn_speeds = 2.0 * np.arccos(np.minimum(turns, 1.0)) / steps
        for values, limit, unit in ((speeds, MAX_SPEED, "m/s"), (turn_speeds, MAX_TURN_SPEED, "rad/s")):
            if len(values) and values.max() > limit:
                row = int(np.argmax(values))
                raise self._make_error(
                    f"{key} must not jump, got {values[row]:.3g} {unit} between rows {first + row + 1} and "
                    f"{first + row + 2}; remove lost tracks, or pass the units (length='mm', time='ms')"
                )

    def _read_fingers(self, fingers: Array, time: Array, rows: tuple[int, int]) -> Array:
        if fingers.shape != (len(time), N_FINGER_ANGLES):
            raise self._make_error(f"fingers must have shape ({len(time)}, {N_FINGER_ANGLES}), got {fingers.shape}")
        angles = fingers[rows[0] : rows[1]]
        if not np.isfinite(angles).all():
            row = int(np.flatnonzero(~np.isfinite(angles).all(axis=1))[0])
            raise self._make_error(f"fingers must be finite where the wrist is, got none in row {rows[0] + row + 1}")
        if np.abs(angles).max() > MAX_FINGER_ANGLE:
            raise self._make_error(f"fingers must be angles in rad, got {np.abs(angles).max():.4g}; convert degrees")
        if self._config.fingers == "rotvec":
            rotations = Rotation.from_rotvec(angles.reshape(-1, 3))
            angles = rotations.as_euler("XYZ").reshape(angles.shape)
        return np.asarray(angles, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class SceneTrajectory:
    """Motion of a scene as in its file, see `handover_marl.datasets.custom.dataset`.

    Attributes:
        object_dof: (T, n, 6) float32.
        hand_dof: (T, 51) float32.
        hand_span: First and last frame with the hand, -1 without one.
    """

    object_dof: npt.NDArray[np.float32]
    hand_dof: npt.NDArray[np.float32]
    hand_span: tuple[int, int]


def make_trajectory(
    table: MotionTable, others: Sequence[str], model: HandGeometry | None, fingers: Array | None
) -> SceneTrajectory:
    """Resample recorded poses of the object and others to 1 kHz.

    Fingers are angles (n, 45) in rad in the rows with the wrist; `model` and `fingers` are None without a hand.
    """
    times = np.arange(np.floor(table.time[-1] / TIME_STEP + 1e-6) + 1.0) * TIME_STEP
    poses = [table.bodies[name] for name in (OBJECT, *others)]
    objects = [resample_poses(table.time, pose[:, :3], Rotation.from_quat(pose[:, 3:]), times) for pose in poses]
    hand, span = np.zeros((len(times), HAND_DOF), dtype=np.float32), (-1, -1)
    if table.wrist is not None and model is not None and fingers is not None:
        recorded = table.time[slice(*table.wrist_rows)]
        frames = np.flatnonzero((times >= recorded[0] - 1e-9) & (times <= recorded[-1] + 1e-9))
        span = (int(frames[0]), int(frames[-1]))
        rotations = Rotation.from_quat(table.wrist[:, 3:])
        # The axes of the hand's base are those of the wrist.
        base = table.wrist[:, :3] - rotations.apply(model.palm_offset)
        shown: Array = np.clip(times[frames], recorded[0], recorded[-1])
        hand[frames, :6] = resample_poses(recorded, base, rotations, shown)
        hand[frames, 6:] = resample_fingers(recorded, fingers, shown)
    return SceneTrajectory(np.stack(objects, axis=1), hand, span)
