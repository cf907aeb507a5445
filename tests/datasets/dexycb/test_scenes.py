import json
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.dexycb.rotations import TagFrame
from handover_marl.datasets.dexycb.scenes import (
    compute_hand_trajectory,
    compute_object_trajectory,
    find_first_betas,
    import_scene,
)
from handover_marl.datasets.official import CACHE_FOLDER
from handover_marl.errors import DataFormatError
from tests.datasets.dexycb.mano_files import made_up_model
from tests.datasets.dexycb.raw_files import RawScene, hand_poses, object_poses, tag_pose

MODELS = {side: made_up_model(side, seed) for seed, side in enumerate(("right", "left"))}
SUBJECT = "20200709-subject-01"


def test_scene_in_the_cache(tmp_path: Path) -> None:
    objects = object_poses(10, 3)
    raw = RawScene(objects=objects, hand=hand_poses(10, 2, 8), side="left", meta={"ycb_ids": [9, 2, 5]})
    sequence = raw.write(tmp_path / "raw", scene_id=42)
    import_scene(sequence, MODELS, find_first_betas([sequence]), tmp_path / "out")
    cache = tmp_path / "out" / CACHE_FOLDER
    assert sorted(path.name for path in cache.iterdir()) == ["meta_042.json", "pose_042.npz"]
    meta = {"name": f"{SUBJECT}/20200709_141754", "ycb_ids": [9, 2, 5], "ycb_grasp_ind": 1, "mano_sides": ["left"]}
    assert (cache / "meta_042.json").read_text() == json.dumps({**meta, "mano_betas": [raw.betas]})
    with np.load(cache / "pose_042.npz", allow_pickle=False) as archive:
        assert archive.files == ["pose_y", "pose_m"]
        pose_y, pose_m = archive["pose_y"], archive["pose_m"]
    assert pose_y.flags.c_contiguous
    assert pose_m.flags.c_contiguous
    tag = TagFrame.from_extrinsics(tag_pose())
    np.testing.assert_array_equal(
        pose_y, np.stack([compute_object_trajectory(objects[:, k], tag) for k in range(3)], axis=1)
    )
    assert pose_m.shape == (361, 1, 51)
    np.testing.assert_array_equal(np.flatnonzero(pose_m.any(axis=(1, 2)))[[0, -1]], [80, 320])


def test_different_motion_is_not_overwritten(tmp_path: Path) -> None:
    sequence, cache = RawScene(hand=hand_poses(6, 1)).write(tmp_path / "raw", scene_id=7), tmp_path / CACHE_FOLDER
    import_scene(sequence, MODELS, {}, tmp_path)
    with np.load(cache / "pose_007.npz") as archive:
        arrays = dict(archive)
    assert arrays["pose_m"][0, 0, 3] == 0.0
    arrays["pose_m"][0, 0, 3] = -0.0
    np.savez_compressed(cache / "pose_007.npz", **arrays)
    before = (cache / "pose_007.npz").read_bytes()
    with pytest.raises(DataFormatError, match=r"pose_007\.npz exists, but differs.*remove it"):
        import_scene(sequence, MODELS, {}, tmp_path)
    assert (cache / "pose_007.npz").read_bytes() == before


def test_base_joint_is_from_the_first_recording(tmp_path: Path) -> None:
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
    base = model.locate_wrist([0.1] * 10)
    for number, own in ((0, 0.1), (1, 0.3)):
        import_scene(sequences[number], MODELS, first, tmp_path / "out")
        with np.load(tmp_path / "out" / CACHE_FOLDER / f"pose_{number:03d}.npz") as archive:
            expected = compute_hand_trajectory(hand_poses(), tag, model, model.locate_wrist([own] * 10), base)
            np.testing.assert_array_equal(archive["pose_m"][:, 0], expected)
    # Recordings that cannot be read are skipped.
    (sequences[0].folder / "meta.yml").write_text("[]")
    (raw / "calibration" / "mano_four" / "mano.yml").unlink()
    assert {key: value[0] for key, value in find_first_betas(sequences).items()} == {
        (SUBJECT, "right"): 0.3,
        (SUBJECT, "left"): 0.2,
    }
