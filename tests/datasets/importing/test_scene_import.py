import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.importing.cache_writer import CACHE_FOLDER
from handover_marl.datasets.importing.hand_motion import hand_trajectory
from handover_marl.datasets.importing.object_motion import object_trajectory
from handover_marl.datasets.importing.scene_import import find_first_betas, import_scene, read_hand_betas
from handover_marl.datasets.importing.sequence_names import SEQUENCE_NAMES
from handover_marl.datasets.importing.tag_frame import TagFrame
from handover_marl.errors import DataFormatError, DataNotFoundError, ResultsError
from tests.datasets.importing.raw_files import RawScene, hand_model, hand_poses, mano_file, object_poses, tag_pose

MODELS = {side: hand_model(side, seed) for seed, side in enumerate(("right", "left"))}
SUBJECT = "20200709-subject-01"


def test_a_scene_in_the_cache(tmp_path: Path) -> None:
    objects = object_poses(10, 3)
    raw = RawScene(objects=objects, hand=hand_poses(10, 2, 8), side="left", meta={"ycb_ids": [9, 2, 5]})
    sequence = raw.write(tmp_path / "raw", scene_id=42)
    import_scene(sequence, MODELS, find_first_betas([sequence]), tmp_path / "out")
    cache = tmp_path / "out" / CACHE_FOLDER
    assert json.loads((cache / "meta_042.json").read_text()) == {
        "name": f"{SUBJECT}/20200709_141754",
        "ycb_ids": [9, 2, 5],
        "ycb_grasp_ind": 1,
        "mano_sides": ["left"],
        "mano_betas": [raw.betas],
    }
    with np.load(cache / "pose_042.npz") as archive:
        pose_y, pose_m = archive["pose_y"], archive["pose_m"]
    tag = TagFrame.from_extrinsics(tag_pose())
    np.testing.assert_array_equal(pose_y, np.stack([object_trajectory(objects[:, k], tag) for k in range(3)], axis=1))
    assert pose_m.shape == (361, 1, 51)
    np.testing.assert_array_equal(np.flatnonzero(pose_m.any(axis=(1, 2)))[[0, -1]], [80, 320])


def test_the_same_twice_and_in_a_worker(tmp_path: Path) -> None:
    sequence = RawScene().write(tmp_path / "raw")
    betas = find_first_betas([sequence])
    import_scene(sequence, MODELS, betas, tmp_path / "out")
    import_scene(sequence, MODELS, betas, tmp_path / "out")
    again = pickle.loads(pickle.dumps((sequence, MODELS, betas)))
    import_scene(*again, tmp_path / "out")


def test_the_first_shape_of_subject_and_side_counts(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    scenes = [
        RawScene(name="20200709_100000", betas=[0.1] * 10, meta={"mano_calib": ["one"]}),
        RawScene(name="20200709_110000", betas=[0.3] * 10, meta={"mano_calib": ["three"]}),
        RawScene(name="20200709_120000", side="left", betas=[0.2] * 10, meta={"mano_calib": ["two"]}),
        RawScene(name="20200709_100000", subject=1, betas=[0.4] * 10, meta={"mano_calib": ["four"]}),
    ]
    sequences = [scene.write(raw, number) for number, scene in enumerate(scenes)]
    for scene, name in zip(scenes, ("one", "three", "two", "four"), strict=True):
        folder = raw / "calibration" / f"mano_{name}"
        folder.mkdir()
        (folder / "mano.yml").write_text(json.dumps({"betas": scene.betas}))
    first = find_first_betas(sequences)
    assert {key: value[0] for key, value in first.items()} == {
        (SUBJECT, "right"): 0.1,
        (SUBJECT, "left"): 0.2,
        ("20200813-subject-02", "right"): 0.4,
    }
    model, tag = MODELS["right"], TagFrame.from_extrinsics(tag_pose())
    base = model.wrist([0.1] * 10)
    for number, own in ((0, 0.1), (1, 0.3)):
        import_scene(sequences[number], MODELS, first, tmp_path / "out")
        with np.load(tmp_path / "out" / CACHE_FOLDER / f"pose_{number:03d}.npz") as archive:
            expected = hand_trajectory(hand_poses(), tag, model, model.wrist([own] * 10), base)
            np.testing.assert_array_equal(archive["pose_m"][:, 0], expected)
    # One that cannot be read is passed over.
    (sequences[0].folder / "meta.yml").write_text("[]")
    (raw / "calibration" / "mano_four" / "mano.yml").unlink()
    assert {key: value[0] for key, value in find_first_betas(sequences).items()} == {
        (SUBJECT, "right"): 0.3,
        (SUBJECT, "left"): 0.2,
    }


def test_hands_are_made_from_the_first_recording(tmp_path: Path) -> None:
    names = SEQUENCE_NAMES[SUBJECT][:3]
    known = [
        RawScene(name=name, betas=[0.1 * rank] * 10, mano=f"hand{rank}").write(tmp_path, rank)
        for rank, name in enumerate(names)
    ]
    assert read_hand_betas(known) == (0.0,) * 10
    # In DexYCB all of a person's are equal, so another will do.
    assert read_hand_betas(known[1:]) == (0.1,) * 10
    mano_file(tmp_path, "hand0").write_text("betas: [1.0]")
    mano_file(tmp_path, "hand1").unlink()
    assert read_hand_betas(known) == (0.2,) * 10
    with pytest.raises(DataFormatError, match="expected 10 numbers"):
        read_hand_betas(known[:2])
    # Of other data nothing is known.
    others = [RawScene(name=f"20200709_00000{rank}").write(tmp_path, rank) for rank in range(2)]
    assert len(read_hand_betas(others)) == 10
    with pytest.raises(DataNotFoundError, match=f"{SUBJECT} lacks its first recording, from which they are made"):
        read_hand_betas(others[1:])
    (others[0].folder / "meta.yml").unlink()
    with pytest.raises(DataNotFoundError, match=r"000000/meta\.yml is missing"):
        read_hand_betas(others)


def test_nothing_is_written_of_a_scene_that_fails(tmp_path: Path) -> None:
    sequence = RawScene(hand=hand_poses(6, 3)).write(tmp_path / "raw")
    with pytest.raises(DataFormatError, match="frames with a hand"):
        import_scene(sequence, MODELS, {}, tmp_path / "out")
    (sequence.folder / "meta.yml").unlink()
    with pytest.raises(DataNotFoundError, match=r"meta\.yml"):
        import_scene(sequence, MODELS, {}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_output_folder_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(ResultsError, match=r"cannot make the folder .*out"):
        import_scene(RawScene().write(tmp_path / "raw"), MODELS, {}, tmp_path / "out")
