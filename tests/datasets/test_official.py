import json
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets import DATA_DIR_VARIABLE, OfficialDataset, open_dataset
from handover_marl.datasets.splits import SETUPS, SPLIT_SIZES, SPLITS, list_split_scenes
from handover_marl.errors import DataFormatError, DataNotFoundError, SceneError
from tests.helpers.fake_layout import HAND_FIRST, HAND_LAST, N_FRAMES, write_grasps
from tests.helpers.fake_layout import motion as make_motion


def edit_meta(data: Path, scene_id: int, **changes: object) -> None:
    path = data / "dex-ycb-cache" / f"meta_{scene_id:03d}.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_scene_is_in_the_world_frame(fake_data: Path) -> None:
    scene = OfficialDataset(fake_data).load_scene(5)
    with np.load(fake_data / "dex-ycb-cache" / "pose_005.npz") as file:
        pose_y, pose_m = file["pose_y"], file["pose_m"][:, 0]
    assert scene.n_frames == N_FRAMES
    assert (scene.hand_first, scene.hand_last) == (HAND_FIRST, HAND_LAST)
    np.testing.assert_array_equal(scene.object_dof[:, :, 2], pose_y[:, :, 2] + np.float32(0.92))
    np.testing.assert_array_equal(np.delete(scene.object_dof, 2, axis=2), np.delete(pose_y, 2, axis=2))
    shown = slice(HAND_FIRST, HAND_LAST + 1)
    np.testing.assert_array_equal(scene.hand_dof[shown, 2], pose_m[shown, 2] + np.float32(0.92))
    assert not scene.hand_dof[:HAND_FIRST].any()
    assert scene.object_dof.dtype == scene.hand_dof.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        scene.object_dof[0, 0, 0] = 1.0


def test_grasped_object_comes_first(fake_data: Path) -> None:
    dataset = OfficialDataset(fake_data)
    scene = dataset.load_scene(14)
    assert scene.info.object_ids == (3, 11, 21)
    assert scene.info.target_name == "004_sugar_box"
    assert [path.parent.name for path in scene.assets.objects] == list(scene.info.object_names)
    moving = np.ptp(scene.object_dof[:, :, 2], axis=0) > 0.1
    np.testing.assert_array_equal(moving, [True, False, False])


def test_missing_folders_and_files_are_named(tmp_path: Path, own_data: Path) -> None:
    with pytest.raises(DataNotFoundError, match=r"nowhere.*HANDOVER_MARL_DATA"):
        open_dataset(data_dir=tmp_path / "nowhere")
    with pytest.raises(DataNotFoundError, match="no data folder given"):
        open_dataset("dexycb")
    dataset = OfficialDataset(own_data)
    with pytest.raises(DataNotFoundError, match="meta_019"):
        dataset.load_scene(19)
    (own_data / "assets" / "003_cracker_box" / "model_normalized.urdf").unlink()
    with pytest.raises(DataNotFoundError, match="003_cracker_box"):
        dataset.compute_fingerprint(5)


def test_data_folder_from_the_environment(fake_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(fake_data))
    assert open_dataset().load_info(5).subject == "20200709-subject-01"
    with pytest.raises(SceneError, match="0 to 999"):
        open_dataset().load_scene(1000)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ycb_ids": []}, "ycb_ids must be"),
        ({"ycb_ids": [19]}, "got .19."),
        ({"ycb_ids": 2}, "not a readable meta file"),
        ({"ycb_ids": [2, 2]}, "1 to 5 different"),
        ({"ycb_ids": [2.0]}, "got .2.0."),
        *(({"ycb_grasp_ind": number}, "ycb_grasp_ind must be") for number in (-1, 0.0)),
        ({"name": 5}, "name must be text, got 5"),
        ({"mano_sides": ["both"]}, "mano_sides"),
    ],
)
def test_bad_meta(own_data: Path, changes: dict[str, object], message: str) -> None:
    edit_meta(own_data, 5, **changes)
    with pytest.raises(DataFormatError, match=f"meta_005.*{message}"):
        OfficialDataset(own_data).load_info(5)


def test_wrong_motion(own_data: Path) -> None:
    for objects, hand in (((10, 2, 6), 10), ((10, 1, 6), 9), ((0, 1, 6), 0), ((10, 1, 6), 10)):
        motion = {"pose_y": np.full(objects, np.nan), "pose_m": np.zeros((hand, 1, 51))}
        np.savez(own_data / "dex-ycb-cache" / "pose_005.npz", **motion)  # type: ignore[arg-type]
        with pytest.raises(DataFormatError, match="pose_005"):
            OfficialDataset(own_data).load_scene(5)
    pose_y, pose_m = make_motion(1, 0)
    lost = np.where((np.arange(N_FRAMES) == 100)[:, None, None], 0.0, pose_m)
    for motion, message in (({"pose_y": 1000.0 * pose_y}, "not mm"), ({"pose_m": lost}, "zero only at start and end")):
        np.savez(own_data / "dex-ycb-cache" / "pose_005.npz", **{"pose_y": pose_y, "pose_m": pose_m, **motion})
        with pytest.raises(DataFormatError, match=rf"pose_005\.npz.*{message}"):
            OfficialDataset(own_data).load_scene(5)


def test_classes_without_grasps(own_data: Path) -> None:
    path = own_data / "assets" / "grasps" / "036_wood_block.npy"
    path.unlink(missing_ok=True)
    assert OfficialDataset(own_data).load_grasps("036_wood_block") is None
    write_grasps(path, n=3)
    assert OfficialDataset(own_data).load_grasps("036_wood_block").shape == (3, 4, 4)


def test_fingerprint_depends_on_meta_grasps_and_meshes(own_data: Path) -> None:
    assets = own_data / "assets"
    urdf = assets / "003_cracker_box" / "model_normalized.urdf"
    urdf.write_text(urdf.read_text().replace('<box size="0.05 0.05 0.08"/>', '<mesh filename="box.obj"/>'))
    seen = [OfficialDataset(own_data).compute_fingerprint(scene_id) for scene_id in (6, 5)]
    for change in (
        lambda: edit_meta(own_data, 5, name="20200709-subject-01/other"),
        lambda: (assets / "003_cracker_box" / "box.obj").write_text("v 0 0 0\n"),
        lambda: (assets / "003_cracker_box" / "box.obj").write_text("v 0 0 0\nv 1 0 0\n"),
        lambda: write_grasps(assets / "grasps" / "003_cracker_box.npy", n=5),
        lambda: urdf.write_text(urdf.read_text() + " "),
    ):
        change()
        seen.append(OfficialDataset(own_data).compute_fingerprint(5))
    assert len(set(seen)) == len(seen)
    write_grasps(assets / "grasps" / "004_sugar_box.npy", n=5)
    assert OfficialDataset(own_data).compute_fingerprint(5) == seen[-1]


def no_side(scene_id: int) -> str:
    raise AssertionError(f"asked for the side of scene {scene_id}")


def test_scenes_of_splits() -> None:
    assert list_split_scenes("s0", "val", no_side)[:2] == (9, 14)
    assert list_split_scenes("s3", "test", no_side)[:2] == (35, 36)
    assert list_split_scenes("s1", "test", no_side)[0] == 705


def test_s2_depends_on_the_side_of_the_last_trial_only() -> None:
    asked = []

    def side(scene_id: int) -> str:
        asked.append(scene_id)
        return "left"

    assert len(list_split_scenes("s2", "test", side)) == 8 * 18 * 3
    assert all(scene % 5 == 4 for scene in asked)


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("split", SPLITS)
def test_splits_have_the_official_sizes(real_dataset: OfficialDataset, setup: str, split: str) -> None:
    assert len(real_dataset.list_scenes(setup, split)) == SPLIT_SIZES[setup, split]


@pytest.mark.parametrize("scene_id", [0, 128, 552, 988])
def test_scene_motion(real_dataset: OfficialDataset, scene_id: int) -> None:
    scene = real_dataset.load_scene(scene_id)
    assert scene.object_dof.shape == (scene.n_frames, 1, 6)
    assert scene.object_dof[:, 0, 2].min() > 0.9
    assert scene.hand_first is not None
    assert scene.hand_last is not None
    assert not scene.hand_dof[: scene.hand_first].any()
    assert scene.hand_dof[scene.hand_first : scene.hand_last + 1].any(axis=1).all()


def test_grasps_exist_for_all_but_the_largest_objects(real_dataset: OfficialDataset) -> None:
    for number in range(1, 20):
        name = real_dataset.load_info(5 * number + 4).target_name
        grasps = real_dataset.load_grasps(name)
        assert (grasps is None) == (name == "036_wood_block"), name
