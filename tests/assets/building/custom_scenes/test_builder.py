"""Tests of folders of custom scenes, from recordings and meshes to results."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.assets.building.custom_scenes import CustomSceneFolder, MeshConfig, builder
from handover_marl.assets.hand_model import make_hand_geometry
from handover_marl.config import TABLE_HEIGHT
from handover_marl.datasets import open_dataset
from handover_marl.datasets.custom.dataset import CustomDataset
from handover_marl.errors import DataFormatError, HandoverError, OptionError, SceneError, UnknownNameError
from handover_marl.evaluation.verification import verify
from tests.helpers.custom_scenes import make_box, make_recording, write_csv
from tests.helpers.equality import read_files
from tests.helpers.short_episodes import shorten_episodes

pytestmark = pytest.mark.usefixtures("own_cache")
MUG = (0.3, 0.3, TABLE_HEIGHT + 0.05, 0.0, 0.0, 0.0, 1.0)


def mirror(recording: dict[str, Any]) -> dict[str, Any]:
    """Return the recording of a left hand, which is mirrored in x about the object's position."""
    result = {name: value.copy() for name, value in recording.items()}
    for key in ("object", "wrist"):
        result[key][:, 0] = 1.2 - result[key][:, 0]
        result[key][:, [4, 5]] *= -1.0
    return result


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> CustomSceneFolder:
    """Return a folder with three scenes of a box.

    A right hand gives the box beside a mug, a left hand gives the box alone, and the box moves without a hand.
    """
    made = CustomSceneFolder(tmp_path_factory.mktemp("own") / "boxes")
    made.add_object("box", make_box(), MeshConfig(mass=0.2, concavity=1.0), grasps=4, workers=1, progress=False)
    recording = make_recording()
    mug = np.tile(MUG, (len(recording["time"]), 1))
    table = write_csv(made.folder.parent / "motion.csv", {**recording, "025_mug": mug})
    made.add_motion(table, "box", "anna", recording="first", others=["025_mug"])
    made.add_motion(mirror(recording), "box", "ben", side="left", hand=3)
    made.add_motion({key: recording[key] for key in ("time", "object")}, "box", "anna", hand=None)
    return made


@pytest.mark.slow
def test_content_of_the_folder(scenes: CustomSceneFolder) -> None:
    dataset = scenes.check()
    assert (dataset.name, dataset.n_scenes, dataset.setups) == ("own:boxes", 3, ("all",))
    (item,) = dataset.content.objects
    assert (item.mass, item.n_grasps, dataset.object_names[22]) == (0.2, 4, "box")
    grasps = dataset.load_grasps("box")
    assert grasps is not None
    assert grasps.shape == (4, 4, 4)
    info = dataset.load_info(0)
    assert (info.name, info.subject, info.side) == ("anna/first", "anna", "right")
    assert (info.object_ids, info.object_names) == ((22, 14), ("box", "025_mug"))
    assert dataset.load_info(1).side == "left"
    assert dataset.list_scenes(None, "test") == (0, 1, 2)
    with pytest.raises(SceneError, match="numbered 0 to 2"):
        dataset.load_info(3)


def test_motion_of_the_scenes(scenes: CustomSceneFolder) -> None:
    recording, scene = make_recording(), scenes.check().load_scene(0)
    assert (scene.n_frames, scene.hand_first, scene.hand_last) == (3001, 0, 3000)
    np.testing.assert_allclose(scene.object_dof[::1000, 0, :3], recording["object"][::60, :3], atol=1e-4)
    np.testing.assert_allclose(scene.object_dof[:, 1, :3], np.tile(MUG[:3], (3001, 1)), atol=1e-6)
    keypoints = make_hand_geometry(6, "right").compute_keypoints(scene.hand_dof[::1000])
    np.testing.assert_allclose(keypoints[:, 0], recording["wrist"][::60, :3], atol=0.025)
    # The hand closes before the object moves: tips are at the surface of the box or outside, and two are near it.
    assert np.abs(scene.hand_dof[-1, 6:] - scene.hand_dof[0, 6:]).max() > 0.1
    np.testing.assert_array_equal(scene.hand_dof[-1, 6:], scene.hand_dof[2500, 6:])
    tips = keypoints[-1, [4, 8, 12, 16, 20]] - scene.object_dof[-1, 0, :3]
    outside = np.abs(tips[:, :2]).max(axis=1)
    assert (outside < 0.06).sum() >= 2
    assert (outside > 0.02).all()


@pytest.mark.parametrize(("physics", "scene_id"), [("exact", 0), ("fast", 1), ("mujoco", 0), ("mujoco", 2)])
def test_every_kind_of_physics(scenes: CustomSceneFolder, physics: str, scene_id: int) -> None:
    env = handover_marl.parallel_env(dataset=scenes.dataset, physics=physics, control_period=0.05)
    observations, _ = env.reset(options={"scene_id": scene_id})
    assert observations["receiver"]["hand_present"][0] == (scene_id < 2)
    action = {"receiver": observations["receiver"]["robot_joint_position"], "giver": np.zeros(8, dtype=np.float32)}
    observations, *_ = env.step(action)
    assert env.observation_space("receiver").contains(observations["receiver"])
    height = TABLE_HEIGHT + 0.081
    np.testing.assert_allclose(observations["receiver"]["object_poses"][0, 2], height, atol=0.003)
    env.close()


@pytest.mark.slow
def test_results_of_custom_scenes(scenes: CustomSceneFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_episodes(monkeypatch, 1000)
    report = handover_marl.evaluate_pair(
        dataset=scenes.dataset,
        scenes=[2],
        receiver="hold",
        physics="fast",
        workers=1,
        out=tmp_path / "out",
        progress=False,
    )
    assert "data: own data: boxes" in report.heading
    assert "all val, 1 of 3 scenes" in report.heading
    assert "Own data: not comparable" in report.format_notes()
    # The path of the folder is passed, because results have only the data set's name.
    assert verify(tmp_path / "out", data_dir=scenes.folder, workers=1, progress=False).is_verified
    with pytest.raises(HandoverError, match="data_dir"):
        verify(tmp_path / "out", workers=1, progress=False)


def moved(keys: Sequence[str], offset: Sequence[float], scale: float = 1.0, **others: Any) -> dict[str, Any]:
    """Return a recording with the positions of some bodies scaled and moved (m)."""
    recording = make_recording()
    for key in keys:
        recording[key][:, :3] = scale * recording[key][:, :3] + offset
    return {**recording, **others}


BOTH, BELOW = ("object", "wrist"), (0.0, 0.0, -TABLE_HEIGHT)
FAULTS: dict[str, tuple[Any, dict[str, Any], str]] = {
    "table's frame": (moved(BOTH, BELOW), {}, r"object must start above the table, got its lowest point 92 cm below"),
    "in the air": (moved(BOTH, (0.0, 0.0, 0.65)), {}, "start on the table, .* lowest point 65 cm above the table"),
    "out of reach": (moved(BOTH, (0.0, 1.5, 0.0)), {}, r"must end within 1\.2 m of the robot's base, got 2\.0"),
    "in mm": (moved(("object",), (0.0, 0.0, 0.0), 1000.0), {}, "within 3 m of the world's origin.*length='mm'"),
    "wrist far away": (
        moved(("wrist",), (0.0, 0.4, 0.0)),
        {},
        r"got only 0 digits that reach it, .*mm from the origin",
    ),
    "wrist inside": (moved(("wrist",), (0.055, -0.06, 0.0)), {}, r"a hand inside of it wherever the wrist is moved"),
    "hand elsewhere": (
        moved(("wrist",), (0.0, 0.0, 1.3), fingers=np.zeros((181, 45))),
        {},
        "the hand must come within 1 m of the object",
    ),
    "no wrist": ({key: make_recording()[key] for key in ("time", "object")}, {}, "no wrist.*pass hand=None"),
    "the object twice": (make_recording(), {"others": ["box"]}, "different classes"),
    "recording with a slash": (make_recording(), {"recording": "a/b", "hand": None}, "recording must be"),
    "known recording": (make_recording(), {"recording": "first", "hand": None}, "recording must be new"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_wrong_motions_change_nothing(kind: str, scenes: CustomSceneFolder) -> None:
    motion, options, message = FAULTS[kind]
    before = read_files(scenes.folder)
    with pytest.raises(HandoverError, match=message):
        scenes.add_motion(motion, **{"object_name": "box", "subject": "anna", **options})
    assert read_files(scenes.folder) == before


def test_splits(scenes: CustomSceneFolder) -> None:
    setup = scenes.add_split("people", "person", val=["ben"], test=0.0)
    assert setup == {"train": (0, 2), "val": (1,), "test": ()}
    assert open_dataset(scenes.dataset).list_scenes("people", "val") == (1,)
    with pytest.raises(UnknownNameError, match="split of setup 'people' is empty"):
        open_dataset(scenes.dataset).list_scenes("people", "test")
    drawn = scenes.add_split("drawn", "random", val=0.34, test=0.34, seed=3)
    assert drawn == scenes.add_split("drawn", "random", val=0.34, test=0.34, seed=3)
    assert sorted(number for numbers in drawn.values() for number in numbers) == [0, 1, 2]
    for name in "012":
        assert scenes.add_split("named", "random", val=0.34, test=[name], seed=3)["test"] == (int(name),)
    for name, options, message in (
        ("s0", {"by": "random"}, "name must not be one of s0, "),
        ("a", {"by": "person", "val": ["carl"]}, "unknown person 'carl'; valid: anna, ben"),
        ("a", {"by": "person", "val": ["ben"], "test": ["ben"]}, "must not share a name"),
    ):
        with pytest.raises(HandoverError, match=message):
            scenes.add_split(name, **options)


@pytest.mark.parametrize("name", ["box", "025_mug", "../x", "wrist"])
def test_objects_that_cannot_be_added(scenes: CustomSceneFolder, name: str) -> None:
    before = read_files(scenes.folder)
    with pytest.raises(HandoverError, match="name must"):
        scenes.add_object(name, make_box(), grasps=0)
    with pytest.raises(HandoverError, match="grasps must be an integer"):
        scenes.add_object("other", make_box(), MeshConfig(concavity=1.0), grasps=-1)
    assert read_files(scenes.folder) == before


def test_an_object_that_another_process_adds_first_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, config = CustomSceneFolder(tmp_path / "own"), MeshConfig(concavity=1.0)

    def add_first(*_: object) -> tuple[np.ndarray, int]:
        monkeypatch.undo()
        folder.add_object("box", make_box(), config, grasps=0)
        return np.zeros((0, 4, 4)), 0

    monkeypatch.setattr(builder, "make_robot_grasps", add_first)
    with pytest.raises(OptionError, match="name must be new, got 'box'"):
        folder.add_object("box", make_box(), replace(config, mass=2.0), grasps=0)
    assert folder.content.objects[0].mass < 2.0


@pytest.mark.slow
def test_grasps_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    folders = [tmp_path / str(workers) / "boxes" for workers in (1, 2)]
    for workers, folder in enumerate(folders, start=1):
        config = MeshConfig(concavity=1.0)
        CustomSceneFolder(folder).add_object("box", make_box(), config, grasps=3, workers=workers, progress=False)
    assert read_files(folders[0]) == read_files(folders[1])


def test_fingerprints_and_missing_files(scenes: CustomSceneFolder, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(scenes.folder, folder)
    fingerprint = CustomDataset(scenes.folder).compute_fingerprint(0)
    assert CustomDataset(folder).compute_fingerprint(0) == fingerprint
    urdf = folder / "objects" / "box" / "model_normalized.urdf"
    urdf.write_text(urdf.read_text().replace("0.9", "0.8"))
    assert CustomDataset(folder).compute_fingerprint(0) != fingerprint
    (folder / "motion" / "000001.npz").unlink()
    with pytest.raises(HandoverError, match=r"000001\.npz does not exist"):
        CustomSceneFolder(folder).check()


def test_a_scene_that_is_removed_by_hand(scenes: CustomSceneFolder, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(scenes.folder, folder)
    content = json.loads((folder / "scenes.json").read_text())
    content["scenes"][0] = content["scenes"].pop()
    content["setups"].clear()
    (folder / "scenes.json").write_text(json.dumps(content))
    (folder / "motion" / "000002.npz").rename(folder / "motion" / "000000.npz")
    dataset = CustomSceneFolder(folder).check()
    assert [dataset.load_info(number).name for number in range(dataset.n_scenes)] == ["anna/000002", "ben/000001"]


#: File, array, place and value that is added in a file of arrays in the folder, and the error.
EDITS: dict[str, tuple[str, str, Any, Any, str]] = {
    "jump": ("motion/000000", "object_dof", np.s_[1500:, 0, 0], 0.1, "box must not jump, got 100 m/s in frame 1500"),
    "no hand": ("motion/000000", "hand_span", np.s_[1], -4000, "hand_span must be frames"),
    "a hand": ("motion/000002", "hand_span", np.s_[:], 9, "hand_span must be -1"),
}


@pytest.mark.parametrize("kind", EDITS)
def test_impossible_values_in_edited_files(kind: str, scenes: CustomSceneFolder, tmp_path: Path) -> None:
    file, key, place, value, message = EDITS[kind]
    folder = tmp_path / "copy"
    shutil.copytree(scenes.folder, folder)
    path = folder / f"{file}.npz"
    arrays = dict(np.load(path))
    arrays[key][place] += value
    np.savez(path, **arrays)
    with pytest.raises(DataFormatError, match=message):
        CustomSceneFolder(folder).check()
    np.savez(path, **{**arrays, key: arrays[key][:1]})
    with pytest.raises(DataFormatError, match="not a readable"):
        CustomSceneFolder(folder).check()
