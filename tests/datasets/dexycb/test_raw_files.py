import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.datasets.dexycb.raw_files import SequenceFolder, find_sequences, read_sequence, read_sequence_names
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.geometry.ycb import SUBJECTS
from tests.datasets.dexycb.raw_files import (
    RawScene,
    extrinsics_file,
    hand_poses,
    mano_file,
    object_poses,
    tag_pose,
    write_yaml,
)


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
    found = read_sequence(sequence := scene.write(tmp_path))
    assert [found.meta[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides")] == [[2, 5], 1, ["right"]]
    np.testing.assert_array_equal(found.world_from_tag, tag_pose())
    assert found.betas == tuple(scene.betas)
    for array, expected in ((found.objects, scene.objects), (found.hand, scene.hand)):
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


DAMAGES: list[tuple[Callable[[SequenceFolder], Any], str]] = [
    (lambda sequence: (sequence.folder / "meta.yml").write_bytes(b""), r"meta\.yml.*expand"),
    (lambda sequence: (sequence.folder / "meta.yml").write_bytes(b"a: [\xff"), r"meta\.yml.*expand"),
    (lambda sequence: (sequence.folder / "pose.npz").write_bytes(b"PK"), r"pose\.npz.*expand"),
    (save_poses(pose_y=OBJECTS[:, :1]), "of 2 objects"),
    (save_poses(pose_m=HAND[:-1]), "of the hand"),
    (save_poses(pose_y=np.full_like(OBJECTS, np.inf)), "not finite"),
    (save_poses(pose_m=np.zeros_like(HAND)), "few have a hand"),
    (lambda sequence: write_yaml(extrinsics_file(sequence.folder.parents[1]), {}), "KeyError: 'extrinsics'"),
    (
        lambda sequence: write_yaml(mano_file(sequence.folder.parents[1]), {"betas": ["x"] * 10}),
        "could not convert string",
    ),
    (lambda sequence: RawScene(meta={"ycb_ids": [2, 99]}).write(sequence.folder.parents[1]), "object class 99"),
    (
        lambda sequence: RawScene(meta={"mano_calib": []}).write(sequence.folder.parents[1]),
        "not a readable file of DexYCB",
    ),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_damaged_recordings(tmp_path: Path, damage: Callable[[SequenceFolder], Any], message: str) -> None:
    sequence = RawScene().write(tmp_path)
    damage(sequence)
    with pytest.raises(DataFormatError, match=message):
        read_sequence(sequence)
