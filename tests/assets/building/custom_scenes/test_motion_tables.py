"""Tests of recorded poses: damaged recordings are refused or repaired, and every repair is stated."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.assets.building.custom_scenes.motion_tables import MotionConfig, make_trajectory, read_motion_table
from handover_marl.assets.hand_model import make_hand_geometry
from handover_marl.config import TABLE_HEIGHT
from handover_marl.errors import DataFormatError, HandoverError, OptionError
from handover_marl.geometry.poses import compose, invert_pose
from tests.helpers.custom_scenes import make_recording, write_csv

ALL = slice(None)


def change(key: str, rows: Any, value: float, columns: Any = ALL) -> dict[str, Any]:
    recording: dict[str, Any] = make_recording()
    recording[key][(rows, columns) if recording[key].ndim > 1 else rows] = value
    return recording


def without(key: str) -> dict[str, Any]:
    return {name: value for name, value in make_recording().items() if name != key}


FAULTS: dict[str, tuple[Any, str]] = {
    "no object": (without("object"), "object is missing"),
    "time goes back": (change("time", 30, 0.1), r"time must be .* increase, got 0\.1 in row 31 after 0\.48"),
    "rows are missing": (
        {name: value[np.r_[0:60, 100:181]] for name, value in make_recording().items()},
        r"gap between rows 60 and 61 must be at most 0\.2 s",
    ),
    "no object at the start": (change("object", slice(0, 3), np.nan), "last row, got none in row 1"),
    "object lost for long": (change("object", slice(50, 90), np.inf, 2), r"no pose from row 51 to 90, for 0\.683 s"),
    "long quaternion": (change("object", 9, 2.0, 6), "quaternion of object must have norm 1, got 2 in row 10"),
    "object is text": ({**make_recording(), "object": np.full((181, 7), "a")}, "must be an array of numbers"),
    "no wrist at all": (change("wrist", ALL, np.nan), "wrist must have poses in at least 2 rows"),
    "fingers of another size": ({**make_recording(), "fingers": np.zeros((181, 40))}, r"must have shape \(181, 45\)"),
    "fingers in degrees": ({**make_recording(), "fingers": np.full((181, 45), 90.0)}, "with a wrist, got 90"),
    "fingers without a wrist": ({**without("wrist"), "fingers": np.zeros((181, 45))}, "fingers need a wrist"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_damaged_recordings_are_refused(kind: str) -> None:
    recording, message = FAULTS[kind]
    with pytest.raises(DataFormatError, match=message):
        read_motion_table(recording, MotionConfig())


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("object_qw", "object_q", "column 'object_qw' is missing"),
        ("object_y", "object_x", "column 'object_x' must be there once, got it twice"),
        ("0.6,", "far,", "column 'object_x' must be a number in line 2, got 'far'"),
        ("\n0,", "\n0,0,", "line 2 must have 15 cells, got 16"),
        ("time,", ",", "column '' is unknown; columns are time, "),
        ("time,", "Time,", "column 'Time' is unknown"),
        ("time,object_x", "\n0,0.1\n#", "the first line must have the names of the columns, such as time,object_x"),
        ("time,", "timestamp_ns,", "column 'timestamp_ns' is unknown"),
    ],
)
def test_damaged_files(before: str, after: str, message: str, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "motion.csv", make_recording())
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(DataFormatError, match=message):
        read_motion_table(path, MotionConfig())
    # Objects are not unpickled.
    np.savez(tmp_path / "motion.npz", time=np.array([{}], dtype=object))
    with pytest.raises(DataFormatError, match="not a readable"):
        read_motion_table(tmp_path / "motion.npz", MotionConfig())


def test_short_gaps_are_filled_and_stated() -> None:
    table = read_motion_table(change("object", slice(70, 76), np.nan), MotionConfig())
    assert table.repairs == ("object: 6 rows without a pose interpolated",)
    np.testing.assert_allclose(table.bodies["object"][:, :3], make_recording()["object"][:, :3], atol=2e-3)


def test_a_hand_that_appears_later() -> None:
    table = read_motion_table(change("wrist", slice(0, 12), np.nan), MotionConfig())
    assert (table.wrist_rows, table.repairs) == ((12, 181), ())
    trajectory = make_trajectory(table, (), make_hand_geometry(6, "right"), np.zeros((169, 45)))
    assert trajectory["hand_span"].tolist() == [200, 3000]
    assert not trajectory["hand_dof"][:200].any()
    assert trajectory["hand_dof"][200:, :3].all()


@pytest.mark.parametrize("separator", [";", "sep=,", '","'])
def test_csv_files_of_spreadsheets(separator: str, tmp_path: Path) -> None:
    """Semicolons may separate decimal commas; Excel writes a line that names the separator, R quotes the header."""
    recording = make_recording()
    path = write_csv(tmp_path / "motion.csv", recording)
    text = path.read_text()
    header, rows = text.split("\n", 1)
    quoted = '"' + header.replace(",", '","') + f'"\n{rows}'
    texts = {"sep=,": f"sep=,\n{text}", '","': quoted}
    path.write_text(texts.get(separator, text.replace(",", separator).replace(".", ",")))
    np.testing.assert_allclose(read_motion_table(path, MotionConfig()).bodies["object"], recording["object"], atol=1e-6)
    path.write_text(text.replace(",", "\t").replace("\t0.6\t", "\t1,200\t", 1))
    with pytest.raises(
        DataFormatError, match="column 'object_x' must be a number in line 2, got '1,200'; use a decimal"
    ):
        read_motion_table(path, MotionConfig())


def write_motive(path: Path, bodies: dict[str, Any], time: Any, old: bool) -> Path:
    """Write poses as Motive does: y up, millimeters, quaternions first, with an error and a marker of each body."""
    kinds, names, parts, axes = ([], [], [], [])
    for name in bodies:
        kinds += ["Rigid Body"] * 8 + ["Rigid Body Marker"] * 3
        names += [f'"{name}"'] * 8 + [f"{name}:Marker1"] * 3
        parts += ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 3
        axes += [*"XYZWXYZ", "", *"XYZ"]
    header = ["Format Version,1.2,Rotation Type,Quaternion,Capture Frame Rate,60.000000,Length Units,Millimeters", ""]
    header += [f",{'' if old else label},{','.join(row)}" for label, row in (("Type", kinds), ("Name", names))]
    header += [f",,{','.join(names)}"] if old else [f",ID,{','.join(names)}", f",Parent{',' * len(names)}"]
    lines = [*header, f",,{','.join(parts)}", f"Frame,Time (Seconds),{','.join(axes)}"]
    for row, seconds in enumerate(time):
        cells = [[*pose[row, 3:], *(1000.0 * pose[row, :3]), 0.1, 1, 2, 3] for pose in bodies.values()]
        lines.append(",".join([str(row), *(f"{cell:.6f}" for cell in (seconds, *np.concatenate(cells)))]))
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


@pytest.mark.parametrize("old", [True, False])
def test_files_of_motive_and_offsets_of_markers(old: bool, tmp_path: Path) -> None:
    """Poses of markers, in a frame with the y axis up, are converted to poses of the object and of the wrist."""
    recording, frame = make_recording(), (0.1, 0.2, TABLE_HEIGHT, 0.5, 0.5, 0.5, 0.5)
    offset = (0.03, -0.01, 0.02, 0.0, 0.6, 0.0, 0.8)
    markers = {
        "object": compose(invert_pose(np.array(frame)), compose(recording["object"], invert_pose(np.array(offset)))),
        "wrist": compose(invert_pose(np.array(frame)), recording["wrist"]),
    }
    path = write_motive(tmp_path / "take.csv", markers, recording["time"], old)
    table = read_motion_table(path, MotionConfig(frame=frame, object_offset=offset))
    np.testing.assert_allclose(table.bodies["object"], recording["object"], atol=1e-5)
    np.testing.assert_allclose(table.wrist, recording["wrist"], atol=1e-5)
    with pytest.raises(HandoverError, match="wrist_offset must be seven numbers"):
        MotionConfig(wrist_offset=(0.0, 0.0, 0.1))


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("object", "Mug", "object is missing; .* this one has time, Mug, wrist; rename"),
        ("1.2", "1" * 200_000, r"take\.csv: field larger than field limit"),
        ("Quaternion", "XYZ", "Rotation Type in the first line must be Quaternion, got XYZ"),
        ("1.2,", "1.2,Coordinate Space,Local,", "Coordinate Space in the first line must be Global, got Local"),
        ("Time (Seconds)", "Seconds", "a file of Motive must have header lines .* the column 'Time .Seconds.'; export"),
        ("Rotation,", "Angle,", "rigid body 'object' must have one column Rotation X, got 0; export quaternions"),
        ("wrist", "object", "rigid body 'object' must have one column Position X, got 2; export"),
        ("Length Units,Millimeters", "", "Length Units in the first line must be Meters or .*, got none"),
        ("0.600000", "abc", "column 'Name Time .Seconds.' must be a number in line 45, got 'abc'"),
        ("Format Version", "Version", "a file of Motive must start with its line 'Format Version,...', got 'Version,"),
    ],
)
def test_files_of_motive_with_faults(before: str, after: str, message: str, tmp_path: Path) -> None:
    recording = make_recording()
    path = write_motive(
        tmp_path / "take.csv", {key: recording[key] for key in ("object", "wrist")}, recording["time"], old=False
    )
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(DataFormatError, match=message):
        read_motion_table(path, MotionConfig())
    path.write_text("")
    with pytest.raises(DataFormatError, match="the file is empty"):
        read_motion_table(path, MotionConfig())


def test_units_frames_and_orders_of_files(tmp_path: Path) -> None:
    """Tables in files, and in other units and frames, are the same table."""
    recording = make_recording()
    expected, changed = recording["object"], {"time": recording["time"] * 1000.0 + 5e6}
    turned = np.roll(expected[:, 3:], 1, axis=1) * np.where(np.arange(181) % 2, -1.0, 1.0)[:, None]
    changed["object"] = np.hstack([(expected[:, :3] - [0.0, 0.0, TABLE_HEIGHT]) * 1000.0, turned])
    np.savez(tmp_path / "motion.npz", **changed)  # type: ignore[arg-type]
    config = MotionConfig(frame="table", length="mm", time="ms", quaternion="wxyz")
    for table in (
        read_motion_table(tmp_path / "motion.npz", config),
        read_motion_table(write_csv(tmp_path / "motion.csv", recording), MotionConfig(quaternion="wxyz")),
    ):
        np.testing.assert_allclose(table.time, recording["time"], atol=1e-6)
        np.testing.assert_allclose(table.bodies["object"][:, :3], expected[:, :3], atol=1e-6)
        np.testing.assert_allclose(np.abs(table.bodies["object"][:, 6]), 1.0)
    rounded: Any = [0.6, 0.3, 0.0, 0.0, 0.0, 0.7, 0.71]
    assert np.linalg.norm(MotionConfig(frame=rounded).frame[3:]) == pytest.approx(1.0)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="frame must be 'world', 'table' or seven numbers"):
        MotionConfig(frame=[*rounded[:5], 0.9, 0.9])  # type: ignore[arg-type]


@pytest.mark.parametrize("rate", [25.0, 119.88, 500.0])
def test_resampling_to_1_khz(rate: float) -> None:
    recording = make_recording(rate)
    trajectory = make_trajectory(read_motion_table(recording, MotionConfig()), (), None, None)
    objects = trajectory["object_dof"]
    times = np.arange(len(objects)) / 1000.0
    assert times[-1] == pytest.approx(recording["time"][-1], abs=1e-3)
    for axis in range(3):
        expected = np.interp(times, recording["time"], recording["object"][:, axis])
        np.testing.assert_allclose(objects[:, 0, axis], expected, atol=1e-3)
    assert not trajectory["hand_dof"].any()
    assert trajectory["hand_span"].tolist() == [-1, -1]
