"""Tables of recorded poses in CSV and NPZ files, with any sampling rate, and their conversion to 1 kHz trajectories.

A CSV file has one header line with the columns `time`, `object_x`, `object_y`, `object_z`, `object_qx`, `object_qy`,
`object_qz`, `object_qw`, the same for `wrist` and for every other object by its class name, and optionally
`finger_0` to `finger_44`. An NPZ file has the arrays `time` (T,), `object` (T, 7), `wrist` (T, 7), one array (T, 7)
for each other object by its class name, and `fingers` (T, 45). Poses are position and quaternion (see `MotionConfig`).

CSV files that OptiTrack's Motive exports, with several header lines, are read too. Their rigid bodies must have the
names `object`, `wrist` and the class names of the other objects.
"""

import contextlib
import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.assets.hand_model import HandGeometry
from handover_marl.config import HAND_DOF, TABLE_HEIGHT, TIME_STEP
from handover_marl.datasets.custom.motion_checks import DURATION, MAX_FINGER_ANGLE
from handover_marl.datasets.generated.motion import resample_fingers, resample_poses
from handover_marl.errors import DataFormatError, OptionError, check_name
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_arrays, read_plain_file, report_damage
from handover_marl.geometry.poses import compose

Array = npt.NDArray[np.float64]

OBJECT, WRIST, TIME = "object", "wrist", "time"
#: Names of arrays that are no poses of other objects.
ARRAY_NAMES: Final = (OBJECT, WRIST, TIME, "fingers")
N_FINGER_ANGLES: Final = 45
# Poses in the world of the frames that have a name: the simulation's world, and the table's frame of DexYCB.
_FRAMES: Final = {"world": (0.0,) * 6 + (1.0,), "table": (0.0, 0.0, TABLE_HEIGHT, 0.0, 0.0, 0.0, 1.0)}
_LENGTHS: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_MOTIVE_LENGTHS: Final = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}
_SETTINGS: Final = {"Rotation Type": ["Quaternion"], "Length Units": [*_MOTIVE_LENGTHS], "Coordinate Space": ["Global"]}
_TIMES: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_PARTS: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")
_MAX_BYTES = 200_000_000
_MAX_NORM_ERROR = 0.02  # of quaternions
_ROUNDING = 1e-9  # of differences of times (s)
_MIN_STEP = 0.2  # smallest distance of rows in time, divided by the median


@dataclass(frozen=True)
class MotionConfig:
    """Frames and units of a table of recorded poses.

    Attributes:
        frame: "world" (origin below the table, z up, the robot's base at (0.61, -0.50, 0.875) m), "table" (the
            same axes with the origin at the height of the table's surface), or the pose of the recording's frame in
            the world: seven numbers, position (m) and quaternion xyzw, or a text of them with commas.
        length: Unit of positions: m, cm or mm.
        time: Unit of times: s, ms, us or ns.
        quaternion: Order of quaternions in NPZ files: xyzw or wxyz; CSV columns have names.
        fingers: Form of finger angles (rad): "euler" (intrinsic XYZ) or "rotvec" (rotation vectors, as in MANO).
        max_gap: Largest gap (s) that is filled by interpolation.
        object_offset: Pose of the handed-over object's frame in the frame that was recorded as `object`, for instance
            the frame of its markers: position (m) and quaternion xyzw; default: the same frame.
        wrist_offset: Pose of the wrist's frame in the frame that was recorded as `wrist`, in the same form.

    Raises:
        UnknownNameError: A name does not exist.
        OptionError: The frame or an offset is no pose, or `max_gap` is out of range.
    """

    frame: str | tuple[float, ...] = "world"
    length: str = "m"
    time: str = "s"
    quaternion: str = "xyzw"
    fingers: str = "euler"
    max_gap: float = 0.2
    object_offset: str | tuple[float, ...] | None = None
    wrist_offset: str | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        check_name("length", self.length, _LENGTHS)
        check_name("time", self.time, _TIMES)
        check_name("quaternion", self.quaternion, ("xyzw", "wxyz"))
        check_name("fingers", self.fingers, ("euler", "rotvec"))
        for name in ("frame", "object_offset", "wrist_offset"):
            pose = getattr(self, name)
            if pose is None or (name == "frame" and isinstance(pose, str) and pose in _FRAMES):
                continue
            parts = pose.split(",") if isinstance(pose, str) else pose
            numbers = np.zeros(7)
            with contextlib.suppress(TypeError, ValueError):
                numbers[:] = np.array(parts, dtype=np.float64).reshape(7)
            norm = float(np.linalg.norm(numbers[3:]))
            if not (np.isfinite(numbers).all() and abs(norm - 1.0) < _MAX_NORM_ERROR):
                names = "'world', 'table' or " if name == "frame" else ""
                raise OptionError(
                    f"{name} must be {names}seven numbers, position (m) and unit quaternion xyzw, got {pose!r}"
                )
            numbers[3:] /= norm
            object.__setattr__(self, name, tuple(numbers.tolist()))
        if not isinstance(self.max_gap, (int, float)) or not 0.0 <= self.max_gap <= 2.0:
            raise OptionError(f"max_gap must be a time from 0 to 2 s, got {self.max_gap!r}")


@dataclass(frozen=True, eq=False)
class MotionTable:
    """Recorded poses of objects and of a person's wrist in the world frame, T rows.

    Attributes:
        time: (T,) times from 0 (s), ascending.
        bodies: Poses (T, 7) of `object` and of the other objects by class name: position (m), quaternion xyzw.
        wrist: Poses (n, 7) of the wrist, in the same form, in the rows of `wrist_rows`; None if there is no wrist.
        wrist_rows: First row with the wrist, and the row after the last.
        fingers: (n, 45) finger joint angles (rad, intrinsic XYZ Euler angles) in these rows; None if not recorded.
        repairs: Changes that were made to the recording.
    """

    time: Array
    bodies: Mapping[str, Array]
    wrist: Array | None
    wrist_rows: tuple[int, int]
    fingers: Array | None
    repairs: tuple[str, ...]


def read_motion_table(source: "str | Path | Mapping[str, npt.ArrayLike]", config: MotionConfig) -> MotionTable:
    """Read poses from a file or arrays as `config` states; raise DataNotFoundError or DataFormatError if that fails."""
    name = "the motion" if isinstance(source, Mapping) else str(Path(source).expanduser())
    try:
        if isinstance(source, Mapping):
            return _make_table(source, config)
        return _make_table(*_read_file(Path(name), config))
    except DataFormatError:
        raise
    except (ValueError, csv.Error) as error:
        raise DataFormatError(f"{name}: {error}") from None


def _read_file(path: Path, config: MotionConfig) -> tuple[dict[str, Any], MotionConfig]:
    """Return the arrays in a file by name, and the configuration with the units and orders that the file states.

    Contents that are no motion raise a `ValueError`.
    """
    if path.suffix.lower() not in (".csv", ".npz"):
        raise ValueError(f"a motion must be a .csv or .npz file, got {path.suffix!r}; convert it")
    with report_damage(path, "motion file", "give the path of a .csv or .npz file, or write it again"):
        if path.suffix.lower() == ".npz":
            return dict(read_arrays(path, largest=_MAX_BYTES)), config
        text = read_plain_file(path, _MAX_BYTES).decode("utf-8-sig")
    # Columns of quaternions have names.
    config = replace(config, quaternion="xyzw")
    if text.startswith("Format Version,"):
        return _parse_motive(text, config)
    if "Rigid Body" in text:
        raise ValueError(
            f"a file of Motive must start with its line 'Format Version,...', got "
            f"{shorten_text(text.partition(chr(10))[0])!r}; export it again with all header lines"
        )
    return _parse_csv(text), config


def _parse_motive(text: str, config: MotionConfig) -> tuple[dict[str, Any], MotionConfig]:
    """Return times and poses (T, 7) by name from Motive's CSV formats 1.2 to 1.25, and `config` with its units."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip(", ")]
    rows = list(csv.reader(line for _, line in lines))
    settings = {"Coordinate Space": "Global", **dict(zip(rows[0][::2], rows[0][1::2], strict=False))}
    for key, valid in _SETTINGS.items():
        if settings.get(key) not in valid:
            raise ValueError(
                f"{key} in the first line must be {' or '.join(valid)}, got {shorten_text(settings.get(key, 'none'))}; "
                "export it again"
            )
    try:
        first = 1 + next(number for number, row in enumerate(rows) if "Frame" in row[:2])
        # Lines of type, name and ID of the columns, in newer formats of the parent, then of the part and the axis.
        columns = [*zip(rows[1], rows[2], rows[first - 2], rows[first - 1], strict=True)]
        time = next(number for number, (*_, axis) in enumerate(columns) if axis.startswith("Time"))
    except (ValueError, IndexError, StopIteration) as error:
        raise ValueError(
            "a file of Motive must have header lines with type, name, part and axis of its columns, and the column "
            "'Time (Seconds)'; export it again with header lines"
        ) from error
    parts, places = [("Position", axis) for axis in "XYZ"] + [("Rotation", axis) for axis in "XYZW"], dict[str, Any]()
    for name in dict.fromkeys(name for kind, name, *_ in columns if kind == "Rigid Body"):
        wanted = [("Rigid Body", name, *part) for part in parts]
        for column in wanted:
            if (count := columns.count(column)) != 1:
                title = f"rigid body {shorten_text(name)!r} must have one column {' '.join(column[2:])}"
                raise ValueError(f"{title}, got {count}; export quaternions, and give bodies different names")
        places[name] = [columns.index(column) for column in wanted]
    values = _parse_rows(lines[first:], ",", [" ".join(words[1:]) for words in columns])
    arrays = {TIME: values[:, time], **{name: values[:, numbers] for name, numbers in places.items()}}
    return arrays, replace(config, time="s", length=_MOTIVE_LENGTHS[settings["Length Units"]])


def _parse_csv(text: str) -> dict[str, Any]:
    """Return the arrays in a CSV file by name; empty cells are NaN.

    Cells are separated by commas, or by semicolons or tabs, which allow decimal commas.
    """
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    lines = [(number, line) for number, line in lines if not line.startswith(("#", "sep="))]
    if len(lines) < 2:
        raise ValueError(f"the file {'has no rows' if lines else 'is empty'}; export it again")
    first_line = lines[0][1]
    if re.fullmatch(r"[-+.,;\s\deE]*", first_line):
        raise ValueError(
            f"the first line must have the names of the columns, such as {TIME},{OBJECT}_x, got "
            f"{shorten_text(first_line)!r}; add it"
        )
    separator = max(",", ";", "\t", key=first_line.count)
    header = [cell.strip() for cell in next(csv.reader([first_line], delimiter=separator))]
    for name in header:
        if header.count(name) > 1:
            raise ValueError(f"column {shorten_text(name)!r} must be there once, got it twice; rename one")
    values = _parse_rows(lines[1:], separator, header)
    bodies = dict.fromkeys(body for body, _, part in (name.rpartition("_") for name in header) if part in _PARTS)
    names = {"fingers": [f"finger_{number}" for number in range(N_FINGER_ANGLES)]}
    names |= {body: [f"{body}_{part}" for part in _PARTS] for body in bodies if body}
    arrays: dict[str, Any] = {TIME: values[:, header.index(TIME)]} if TIME in header else {}
    for key, columns in names.items():
        missing = [name for name in columns if name not in header]
        if 0 < len(missing) < len(columns):
            raise ValueError(f"column {shorten_text(missing[0])!r} is missing; it belongs to {', '.join(columns[:7])}")
        if not missing:
            arrays[key] = values[:, [header.index(name) for name in columns]]
    for name in header:
        if name != TIME and not any(name in columns for columns in names.values()):
            raise ValueError(
                f"column {shorten_text(name)!r} is unknown; columns are {TIME}, BODY_x, _y, _z, _qx, _qy, _qz, _qw and "
                "finger_0 to finger_44; rename or remove it"
            )
    return arrays


def _parse_rows(lines: Sequence[tuple[int, str]], separator: str, columns: Sequence[str]) -> Array:
    """Return the numbers (T, c) in `lines`, pairs of a line's number in the file and its text; empty cells are NaN."""
    values = np.empty((len(lines), len(columns)))
    for row, (number, line) in enumerate(lines):
        cells = next(csv.reader([line], delimiter=separator))
        if len(cells) != len(columns):
            raise ValueError(f"line {number} must have {len(columns)} cells, got {len(cells)}; export it again")
        for column, cell in enumerate(cells):
            try:
                # In "1,200", the comma may also separate thousands.
                is_unclear = separator != ";" and "," in cell and _THOUSANDS.fullmatch(cell.strip())
                values[row, column] = float(cell if is_unclear else cell.replace(",", ".").strip() or "nan")
            except ValueError:
                raise ValueError(
                    f"column {shorten_text(columns[column])!r} must be a number in line {number}, got "
                    f"{shorten_text(cell)!r}; use a decimal point, or leave it empty if the body was not tracked"
                ) from None
    return values


def _make_table(arrays: Mapping[str, Any], config: MotionConfig) -> MotionTable:
    """Return the poses in arrays, checked and repaired; raise `ValueError` if they cannot be repaired."""
    for key in (TIME, OBJECT):
        if key not in arrays:
            raise ValueError(
                f"{key} is missing; a motion has {TIME}, {OBJECT} and optionally {WRIST}, but this one has "
                f"{shorten_text(', '.join(arrays))}; rename its bodies"
            )
    numbers, repairs = dict[str, Array](), list[str]()
    for key, value in arrays.items():
        try:
            numbers[key] = np.array(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{shorten_text(key)} must be an array of numbers ({error}); write it again") from None
    time, fingers = _read_time(numbers.pop(TIME), config, repairs), numbers.pop("fingers", None)
    for key, poses in numbers.items():
        if poses.shape != (len(time), 7):
            raise ValueError(f"{shorten_text(key)} must have shape ({len(time)}, 7), got {poses.shape}")
    wrist, rows, angles = numbers.pop(WRIST, None), (0, 0), None
    bodies = {key: _read_poses(key, poses, time, 0, config, repairs) for key, poses in numbers.items()}
    if wrist is not None:
        present = np.flatnonzero(np.isfinite(wrist).all(axis=1))
        if len(present) < 2:
            raise ValueError("wrist must have poses in at least 2 rows; leave it out for a scene without a hand")
        rows = int(present[0]), int(present[-1]) + 1
        wrist = _read_poses(WRIST, wrist[slice(*rows)], time[slice(*rows)], rows[0], config, repairs)
    if fingers is not None:
        if wrist is None:
            raise ValueError("fingers need a wrist; add its poses or leave the fingers out")
        if fingers.shape != (len(time), N_FINGER_ANGLES):
            raise ValueError(f"fingers must have shape ({len(time)}, {N_FINGER_ANGLES}), got {fingers.shape}")
        angles = fingers[slice(*rows)]
        if not (np.abs(angles) <= MAX_FINGER_ANGLE).all():
            raise ValueError(f"fingers must be angles (rad) in all rows with a wrist, got {np.abs(angles).max():.4g}")
        if config.fingers == "rotvec":
            angles = Rotation.from_rotvec(angles.reshape(-1, 3)).as_euler("XYZ").reshape(angles.shape)
    return MotionTable(time, bodies, wrist, rows, angles, tuple(repairs))


def _read_time(time: Array, config: MotionConfig, repairs: list[str]) -> Array:
    """Return times from 0 (s); note short gaps, which are interpolated later, in `repairs`.

    Times that do not increase or nearly coincide, a duration out of range or a gap over `max_gap` raise a `ValueError`.
    """
    if time.ndim != 1 or len(time) < 2:
        raise ValueError(f"time must have shape (T,) with at least 2 rows, got shape {time.shape}")
    seconds: Array = (time - time[0]) * _TIMES[config.time]
    steps = np.diff(seconds)
    if not (steps > 0.0).all():
        row = int(np.argmin(steps > 0.0)) + 1
        raise ValueError(
            f"time must be finite and increase, got {time[row]:g} in row {row + 1} after {time[row - 1]:g}; sort the "
            "rows and remove repeated ones"
        )
    if not DURATION[0] <= seconds[-1] <= DURATION[1]:
        raise ValueError(
            f"a motion must last {DURATION[0]} to {DURATION[1]:g} s, got {seconds[-1]:.4g} s; cut it, or pass "
            "the unit of time (time='ms')"
        )
    if steps.max() > config.max_gap + _ROUNDING:
        row = int(np.argmax(steps))
        raise ValueError(
            f"the gap between rows {row + 1} and {row + 2} must be at most {config.max_gap:g} s (max_gap), "
            f"got {steps[row]:.3g} s; record again or raise max_gap"
        )
    if steps.min() < _MIN_STEP * float(np.median(steps)):
        row = int(np.argmin(steps))
        raise ValueError(
            f"rows must be at least {_MIN_STEP:g} times their usual distance in time apart, got {steps[row]:.3g} s "
            f"between rows {row + 1} and {row + 2}: splines through them would jump; remove one of the rows"
        )
    if steps.max() > 1.5 * float(np.median(steps)):
        repairs.append(f"gaps of up to {steps.max():.3g} s between rows interpolated")
    return seconds


def _read_poses(key: str, poses: Array, time: Array, first: int, config: MotionConfig, repairs: list[str]) -> Array:
    """Return poses (n, 7) of body `key` in the world, with gaps filled; `poses[0]` is row `first` of the recording."""
    if config.quaternion == "wxyz":
        poses[:, 3:] = np.roll(poses[:, 3:], -1, axis=1)
    poses[:, :3] *= _LENGTHS[config.length]
    poses = _fill_gaps(key, poses, time, first, config, repairs)
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1.0) > _MAX_NORM_ERROR)
    if len(wrong):
        raise ValueError(
            f"the quaternion of {key} must have norm 1, got {norms[wrong[0]]:.4g} in row {first + wrong[0] + 1}; "
            "check the columns and their order"
        )
    poses[:, 3:] /= norms[:, None]
    offset = {OBJECT: config.object_offset, WRIST: config.wrist_offset}.get(key)
    poses = poses if offset is None else np.asarray(compose(poses, np.array(offset)))
    frame = _FRAMES[config.frame] if isinstance(config.frame, str) else config.frame
    return np.asarray(compose(np.array(frame, dtype=np.float64), poses))


def _fill_gaps(key: str, poses: Array, time: Array, first: int, config: MotionConfig, repairs: list[str]) -> Array:
    """Fill gaps in poses (n, 7) of body `key`, noted in `repairs`; a long gap or one at an end raises `ValueError`."""
    is_valid = np.asarray(np.isfinite(poses).all(axis=1))
    valid, missing = np.flatnonzero(is_valid), np.flatnonzero(~is_valid)
    if not len(missing):
        return poses
    if len(valid) < 2 or valid[0] > 0 or valid[-1] < len(poses) - 1:
        raise ValueError(
            f"{key} must have poses in the first and the last row, got none in row {first + int(missing[0]) + 1}; "
            "cut the recording"
        )
    gaps = np.where(np.diff(valid) > 1, np.diff(time[valid]), 0.0)
    longest = int(np.argmax(gaps))
    if gaps[longest] > config.max_gap + _ROUNDING:
        raise ValueError(
            f"{key} has no pose from row {first + int(valid[longest]) + 2} to {first + int(valid[longest + 1])}, "
            f"for {gaps[longest]:.3g} s; gaps must be at most max_gap={config.max_gap:g} s. Record it again "
            "or raise max_gap"
        )
    filled = CubicSpline(time[valid], poses[valid, :3])(time)
    turns = Slerp(time[valid], Rotation.from_quat(poses[valid, 3:]))(time)
    repairs.append(f"{key}: {len(missing)} rows without a pose interpolated")
    return np.where(is_valid[:, None], poses, np.concatenate([filled, turns.as_quat()], axis=1))


def make_trajectory(
    table: MotionTable, others: Sequence[str], model: HandGeometry | None, fingers: Array | None
) -> dict[str, npt.NDArray[Any]]:
    """Resample recorded poses to 1 kHz; return the arrays `object_dof`, `hand_dof` and `hand_span` of a motion file.

    `others` are the other objects, in the order of the result; `fingers` (n, 45) are angles (rad) in the rows with the
    wrist. `model` and `fingers` are None if there is no hand.
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
    return {"object_dof": np.stack(objects, axis=1), "hand_dof": hand, "hand_span": np.array(span)}
