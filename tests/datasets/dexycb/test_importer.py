"""Tests of raw recordings and of the whole import: damaged files, folders with other files, imports that are killed."""

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.datasets import OfficialDataset
from handover_marl.datasets.dexycb.importer import ImportReport, import_dexycb
from handover_marl.datasets.dexycb.scenes import SequenceFolder, find_sequences, read_sequence, read_sequence_names
from handover_marl.datasets.official import CACHE_FOLDER, list_required_files
from handover_marl.errors import (
    DataFormatError,
    DataNotFoundError,
    OptionError,
    ResultsError,
    SceneError,
    UnsafeFileError,
)
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.raw_files import (
    RawScene,
    extrinsics_file,
    hand_poses,
    mano_file,
    object_poses,
    tag_pose,
    write_mano,
    write_yaml,
)
from tests.helpers.equality import read_files

N_SCENES = 6
N_KEYS = 24  # number for which an import takes long enough to be killed half-way
NAMES = read_sequence_names()[SUBJECTS[0]][:N_SCENES]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with raw data `raw/`, models `mano/` and the result of their import `expected/`."""
    folder = tmp_path_factory.mktemp("given")
    write_mano(folder / "mano")
    for name in NAMES:
        objects, hand = object_poses(N_KEYS, 2), hand_poses(N_KEYS)
        RawScene(name=name, objects=objects, hand=hand, mano=name).write(folder / "raw")
    assert imported(folder, folder / "raw", folder / "expected").scenes == tuple(range(N_SCENES))
    return folder


def imported(given: Path, raw: Path, out: Path) -> ImportReport:
    return import_dexycb(raw, given / "mano", out, workers=1, progress=False)


@pytest.mark.slow
def test_damaged_recordings_are_reported_and_the_others_imported(given: Path, tmp_path: Path) -> None:
    raw, out = tmp_path / "raw", tmp_path / "out"
    shutil.copytree(given / "raw", raw)
    folder = raw / SUBJECTS[0]
    (folder / NAMES[0] / "pose.npz").write_bytes((folder / NAMES[0] / "pose.npz").read_bytes()[:500])
    (folder / NAMES[1] / "meta.yml").unlink()
    mano_file(raw, NAMES[3]).unlink()
    found = imported(given, raw, out)
    assert found.scenes == (2, 4, 5)
    assert len(found.hands) == 2
    for name in (NAMES[0], NAMES[1], NAMES[3]):
        assert len([fault for fault in found.faults if name in fault and fault.startswith("scene")]) == 1
    assert len(found.faults) == 3 + len(SUBJECTS)
    assert set(found.missing_files) == set(list_required_files())
    assert "assets-3rd-party" in str(found)
    files, expected = read_files(out), read_files(given / "expected")
    assert files.items() <= expected.items()
    assert {"assets/table/table.urdf", "assets/003_cracker_box/model_normalized.urdf"} <= set(files)
    info = OfficialDataset(out).load_info(2)
    assert (info.name, info.side, info.object_ids) == (f"{SUBJECTS[0]}/{NAMES[2]}", "right", (5, 2))
    # An import of the undamaged data completes the folder.
    imported(given, given / "raw", out)
    assert read_files(out) == expected


def alter(path: Path) -> None:
    """Change one number of the motion in a pose file."""
    with np.load(path) as archive:
        arrays = {name: archive[name].copy() for name in archive.files}
    arrays["pose_m"][3, 0, 5] += 1e-6
    np.savez_compressed(path, **arrays)


SPOILS: dict[str, Callable[[Path], object]] = {
    "pose_000.npz": alter,
    "pose_001.npz": lambda path: path.write_bytes(path.read_bytes()[:500]),
    "meta_002.json": lambda path: path.write_text(path.read_text().replace("2, 5", "5, 2")),
}


def test_existing_files_are_checked_and_kept(given: Path, tmp_path: Path) -> None:
    raw, out = tmp_path / "raw", tmp_path / "out"
    shutil.copytree(given / "expected", out)
    for name, spoil in SPOILS.items():
        spoil(out / CACHE_FOLDER / name)
    before = read_files(out)
    found = imported(given, given / "raw", out)
    assert found.scenes == tuple(range(len(SPOILS), N_SCENES))
    for name in SPOILS:
        assert any(f"{name} exists, but differs from the result" in fault for fault in found.faults)
    # Models of other data are kept, too.
    shutil.copytree(given / "raw", raw)
    for name in NAMES:
        write_yaml(mano_file(raw, name), {"betas": [0.3] * 10})
    with pytest.raises(ResultsError, match="exists with other content"):
        imported(given, raw, out)
    assert read_files(out) == before


@pytest.mark.slow
def test_killed_import_is_continued(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = "import sys; from handover_marl.cli import main\nsys.exit(main(['import', *sys.argv[1:]]))"
    options = ["--dexycb", given / "raw", "--mano", given / "mano", "--out", out, "--workers", 1, "--no-progress"]
    with subprocess.Popen([sys.executable, "-c", script, *map(str, options)], stderr=subprocess.DEVNULL) as process:
        end = time.monotonic() + 60.0
        while not list((out / CACHE_FOLDER).glob("meta_*")) and time.monotonic() < end:
            time.sleep(0.01)
        process.kill()
    found, expected = read_files(out), read_files(given / "expected")
    assert {name: data for name, data in found.items() if not name.endswith(".part")}.items() <= expected.items()
    imported(given, given / "raw", out)
    assert read_files(out) == expected


def test_invalid_arguments(given: Path, tmp_path: Path) -> None:
    raw, mano, out, hostile = given / "raw", given / "mano", tmp_path / "out", tmp_path / "mano"
    shutil.copytree(mano, hostile)
    (hostile / "MANO_LEFT.pkl").write_bytes(b"cos\nsystem\n(S'touch /tmp/no'\ntR.")
    cases: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
        ((tmp_path, mano), {}, DataNotFoundError, "no raw DexYCB folder"),
        ((raw, tmp_path), {}, DataNotFoundError, r"MANO_RIGHT\.pkl does not exist; copy it from mano_v1_2\.zip"),
        ((raw, mano), {"scenes": [1000]}, SceneError, "scene 1000 is not in DexYCB"),
        ((raw, mano), {"workers": 0}, OptionError, r"workers must be .* got 0"),
        (("", mano), {}, OptionError, "dexycb must be a path"),
        ((raw, hostile), {}, UnsafeFileError, r"MANO_LEFT\.pkl"),
    ]
    for (dexycb, models), options, error, message in cases:
        with pytest.raises(error, match=message):
            import_dexycb(dexycb, models, out, **options)
    assert not out.exists()


def test_command(given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = ["--dexycb", str(given / "raw"), "--mano", str(given / "mano"), "--out", str(tmp_path / "out")]
    assert main(["import", *folders, "--scenes", "999", "--workers", "1", "--no-progress"]) == 1
    assert "0 scenes, 2 hands" in capsys.readouterr().out


def write_names(raw: Path, number: int, names: list[str]) -> None:
    """Create the folders of recordings with these names, and an empty calibration folder."""
    (raw / "calibration").mkdir(exist_ok=True)
    for name in names:
        (raw / SUBJECTS[number] / name).mkdir(parents=True)


def test_sequence_names() -> None:
    names = [f"{subject}/{name}" for subject in SUBJECTS for name in read_sequence_names()[subject]]
    assert len(set(names)) == 1000
    assert names == sorted(names)
    assert all(re.fullmatch(r"(\d{8})-subject-\d\d/\1_[0-2]\d[0-5]\d[0-5]\d", name) for name in names)


@pytest.mark.parametrize("ranks", [range(100), (3, 50, 99)])
def test_dexycbs_recordings_have_their_official_numbers(tmp_path: Path, ranks: range) -> None:
    names = read_sequence_names()[SUBJECTS[6]]
    write_names(tmp_path, 6, [*(names[rank] for rank in reversed(ranks)), "20200928_000000", "backup"])
    sequences, missing = find_sequences(tmp_path)
    assert [(one.scene_id - 600, one.folder.name) for one in sequences] == [(rank, names[rank]) for rank in ranks]
    assert (sequences[0].subject, sequences[0].calibration) == (SUBJECTS[6], tmp_path / "calibration")
    reported = [text for text in missing if f"lacks {100 - len(ranks)} of 100 recordings" in text]
    assert (len(missing), len(reported)) == ((9, 0) if len(ranks) == 100 else (10, 1))


def test_other_recordings_are_numbered_if_all_are_there(tmp_path: Path) -> None:
    names = [f"20200903_{9000 + 7 * rank:06d}" for rank in range(100)]
    write_names(tmp_path, 3, names[::-1])
    assert [one.folder.name for one in find_sequences(tmp_path)[0]] == names
    shutil.rmtree(tmp_path / SUBJECTS[3] / names[0])
    assert not find_sequences(tmp_path)[0]


def test_recording_and_missing_files(tmp_path: Path) -> None:
    scene = RawScene(side="right")
    meta, world_from_tag, betas, objects, hand = read_sequence(sequence := scene.write(tmp_path))
    assert [meta[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides")] == [[2, 5], 1, ["right"]]
    np.testing.assert_array_equal(world_from_tag, tag_pose())
    assert betas == tuple(scene.betas)
    for array, expected in ((objects, scene.objects), (hand, scene.hand)):
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, expected)
    for path in (mano_file(tmp_path), extrinsics_file(tmp_path), sequence.folder / "meta.yml"):
        path.unlink()
        with pytest.raises(DataNotFoundError, match=f"{re.escape(str(path))} does not exist"):
            read_sequence(sequence)


OBJECTS, HAND = object_poses(n_objects=2), hand_poses()[:, None]


def save_poses(**arrays: np.ndarray) -> Callable[[SequenceFolder], object]:
    given = {"pose_y": OBJECTS, "pose_m": HAND, **arrays}
    return lambda sequence: np.savez(sequence.folder / "pose.npz", **given)  # type: ignore[arg-type]


def find_raw(sequence: SequenceFolder) -> Path:
    return sequence.folder.parents[1]


DAMAGES: list[tuple[Callable[[SequenceFolder], Any], str]] = [
    (lambda sequence: (sequence.folder / "meta.yml").write_bytes(b""), r"meta\.yml.*expand"),
    (lambda sequence: (sequence.folder / "meta.yml").write_bytes(b"a: [\xff"), r"meta\.yml.*expand"),
    (lambda sequence: (sequence.folder / "pose.npz").write_bytes(b"PK"), r"pose\.npz.*expand"),
    (save_poses(pose_y=OBJECTS[:, :1]), r"pose_y must be finite numbers of shape \('T', 2, 7\)"),
    (save_poses(pose_m=HAND[:-1]), "pose_m must be finite"),
    (save_poses(pose_y=np.full_like(OBJECTS, np.inf)), "pose_y must be finite"),
    (save_poses(pose_m=np.zeros_like(HAND)), "few have a hand"),
    (save_poses(pose_m=np.concatenate([HAND[:2], 0 * HAND[:1], HAND[3:]])), "zero only at start and end"),
    (lambda sequence: write_yaml(extrinsics_file(find_raw(sequence)), {}), "KeyError: 'extrinsics'"),
    (lambda sequence: write_yaml(mano_file(find_raw(sequence)), {"betas": ["x"] * 10}), "could not convert string"),
    (lambda sequence: RawScene(meta={"ycb_ids": [2, 99]}).write(find_raw(sequence)), r"got .2, 99."),
    (lambda sequence: RawScene(meta={"mano_calib": []}).write(find_raw(sequence)), "not a readable file of DexYCB"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_damaged_recordings(tmp_path: Path, damage: Callable[[SequenceFolder], Any], message: str) -> None:
    sequence = RawScene().write(tmp_path)
    damage(sequence)
    with pytest.raises(DataFormatError, match=message):
        read_sequence(sequence)
