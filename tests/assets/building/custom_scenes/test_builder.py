"""Tests of folders of custom scenes, from recordings and meshes to results."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.assets.building.custom_scenes import CustomSceneFolder, MeshConfig, MotionConfig
from handover_marl.assets.building.custom_scenes.finger_closing import find_hand_grasp
from handover_marl.assets.hand_model import make_hand_geometry
from handover_marl.config import TABLE_HEIGHT
from handover_marl.datasets import open_dataset
from handover_marl.datasets.custom import CustomDataset
from handover_marl.datasets.generated.shapes import Part, Solid, make_surface
from handover_marl.errors import DataFormatError, HandoverError, OptionError, SceneError, UnknownNameError
from handover_marl.evaluation.verification import verify
from handover_marl.simulation.engines import PHYSICS
from tests.custom_scenes import WRIST_IN_OBJECT, WRIST_ROTATION, make_box, make_recording, write_csv

pytest.importorskip("mujoco", reason="MuJoCo validates the grasps of new objects")

MUG = (0.3, 0.3, TABLE_HEIGHT + 0.05, 0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


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
    builder = CustomSceneFolder(tmp_path_factory.mktemp("own") / "boxes")
    builder.add_object("box", make_box(), MeshConfig(mass=0.2, concavity=1.0), grasps=8, workers=1, progress=False)
    recording = make_recording()
    mug = np.tile(MUG, (len(recording["time"]), 1))
    table = write_csv(builder.folder.parent / "motion.csv", {**recording, "025_mug": mug})
    builder.add_motion(table, "box", "anna", recording="first", others=["025_mug"])
    builder.add_motion(mirror(recording), "box", "ben", side="left", hand=3)
    builder.add_motion({key: recording[key] for key in ("time", "object")}, "box", "anna", hand=None)
    return builder


def list_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_content_of_the_folder(scenes: CustomSceneFolder) -> None:
    dataset = scenes.check()
    assert (dataset.name, dataset.n_scenes, dataset.setups) == ("own:boxes", 3, ("all",))
    assert dataset.object_names[22] == "box"
    (item,) = dataset.content.objects
    assert (item.mass, item.n_grasps) == (0.2, 8)
    assert item.n_candidates >= 8
    grasps = dataset.load_grasps("box")
    assert grasps is not None
    assert grasps.shape == (8, 4, 4)
    info = dataset.load_info(0)
    assert (info.name, info.subject, info.side) == ("anna/first", "anna", "right")
    assert (info.object_ids, info.object_names) == ((22, 14), ("box", "025_mug"))
    assert dataset.load_info(1).side == "left"
    assert dataset.list_scenes(None, "test") == (0, 1, 2)
    with pytest.raises(SceneError, match="numbered 0 to 2"):
        dataset.load_info(3)


def test_motion_of_the_scenes(scenes: CustomSceneFolder) -> None:
    recording = make_recording()
    scene = scenes.check().load_scene(0)
    assert scene.n_frames == 3001
    assert (scene.hand_first, scene.hand_last) == (0, 3000)
    np.testing.assert_allclose(scene.object_dof[::1000, 0, :3], recording["object"][::60, :3], atol=1e-4)
    np.testing.assert_allclose(scene.object_dof[:, 1, :3], np.tile(MUG[:3], (3001, 1)), atol=1e-6)
    model = make_hand_geometry(6, "right")
    wrists = model.compute_keypoints(scene.hand_dof[::1000])[:, 0]
    np.testing.assert_allclose(wrists, recording["wrist"][::60, :3], atol=0.025)


def test_a_hand_closes_on_the_object(scenes: CustomSceneFolder) -> None:
    scene = scenes.check().load_scene(0)
    start, end = scene.hand_dof[0, 6:], scene.hand_dof[-1, 6:]
    assert np.abs(end - start).max() > 0.1
    np.testing.assert_array_equal(end, scene.hand_dof[2500, 6:])
    model = make_hand_geometry(6, "right")
    tips = model.compute_keypoints(scene.hand_dof[-1])[[4, 8, 12, 16, 20]] - scene.object_dof[-1, 0, :3]
    # All fingertips are at the surface of the box or outside, and at least two are near it.
    outside = np.abs(tips[:, :2]).max(axis=1)
    assert (outside < 0.06).sum() >= 2
    assert (outside > 0.02).all()


def test_left_hands_are_mirrored_right_hands() -> None:
    position, rotation = np.array(WRIST_IN_OBJECT), np.array(WRIST_ROTATION)
    solid = Solid([make_surface(Part("box", (0.025, 0.025, 0.08), "red"))])
    right = find_hand_grasp(solid, np.array([*position, *rotation]), 6, "right", "")
    mirrored = np.array([-position[0], *position[1:], rotation[0], -rotation[1], -rotation[2], rotation[3]])
    left = find_hand_grasp(solid, mirrored, 6, "left", "")
    np.testing.assert_allclose(left.closed, right.closed * np.tile([1.0, -1.0, -1.0], 15), atol=0.12)
    np.testing.assert_allclose(left.shift, right.shift * [-1.0, 1.0, 1.0], atol=1e-9)


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("scene_id", range(3))
def test_every_kind_of_physics(scenes: CustomSceneFolder, physics: str, scene_id: int) -> None:
    env = handover_marl.parallel_env(dataset=scenes.dataset, physics=physics, control_period=0.05)
    observations, _ = env.reset(options={"scene_id": scene_id})
    assert observations["receiver"]["hand_present"][0] == (scene_id < 2)
    action = {"receiver": observations["receiver"]["robot_joint_position"], "giver": np.zeros(8, dtype=np.float32)}
    for _ in range(3):
        observations, *_ = env.step(action)
    assert env.observation_space("receiver").contains(observations["receiver"])
    height = TABLE_HEIGHT + 0.081
    np.testing.assert_allclose(observations["receiver"]["object_poses"][0, 2], height, atol=0.003)
    env.close()


@pytest.mark.slow
def test_results_of_custom_scenes(scenes: CustomSceneFolder, tmp_path: Path) -> None:
    report = handover_marl.evaluate_pair(
        receiver="yang2021", dataset=scenes.dataset, physics="fast", workers=1, out=tmp_path / "out", progress=False
    )
    assert "data: own data: boxes" in report.heading
    assert "all test, all 3 scenes" in report.heading
    assert "Own data: not comparable" in report.format_notes()
    assert {episode.object_name for episode in report.episodes} == {"box"}
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
MUG_BELOW = np.tile(MUG, (181, 1)) - [0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0]
FAULTS: dict[str, tuple[Any, dict[str, Any], str]] = {
    "table's frame": (moved(BOTH, BELOW), {}, r"object must start above the table, got its lowest point 92 cm below"),
    "out of reach": (moved(BOTH, (0.0, 1.5, 0.0)), {}, r"must end within 1\.2 m of the robot's base, got 2\.0"),
    "in mm": (moved(("object",), (0.0, 0.0, 0.0), 1000.0), {}, "within 3 m of the world's origin.*length='mm'"),
    "wrist far away": (moved(("wrist",), (0.0, 0.4, 0.0)), {}, r"wrist must be where the fingers reach.*mm away"),
    "wrist inside": (moved(("wrist",), (0.055, -0.06, 0.0)), {}, r"wrist must be where the fingers reach.*mm inside"),
    "other object below": (moved((), ()) | {"025_mug": MUG_BELOW}, {"others": ["025_mug"]}, "025_mug must start above"),
    "hand elsewhere": (
        moved(("wrist",), (0.0, 0.0, 1.3), fingers=np.zeros((181, 45))),
        {},
        "the hand must come within 1 m of the object",
    ),
    "no wrist": ({key: make_recording()[key] for key in ("time", "object")}, {}, "no wrist.*pass hand=None"),
    "poses of others": ({**make_recording(), "cup": make_recording()["object"]}, {}, "has poses of 'cup'"),
    "the object twice": (make_recording(), {"others": ["box"]}, "different classes"),
    "hand": (make_recording(), {"hand": 11}, "unknown hand"),
    "person": (make_recording(), {"subject": "a/b"}, "subject must be"),
    "known recording": (make_recording(), {"recording": "first", "hand": None}, "recording must be new"),
    "motion": (3, {}, "motion must be a path"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_wrong_motions_change_nothing(kind: str, scenes: CustomSceneFolder) -> None:
    motion, options, message = FAULTS[kind]
    before = list_files(scenes.folder)
    arguments = {"object_name": "box", "subject": "anna", **options}
    with pytest.raises(HandoverError, match=message):
        scenes.add_motion(motion, **arguments)
    assert list_files(scenes.folder) == before


def test_splits(scenes: CustomSceneFolder) -> None:
    setup = scenes.add_split("people", "person", val=["ben"], test=0.0)
    assert setup == {"train": (0, 2), "val": (1,), "test": ()}
    assert scenes.check().setups == ("all", "people")
    assert open_dataset(scenes.dataset).list_scenes("people", "val") == (1,)
    with pytest.raises(UnknownNameError, match="split of setup 'people' is empty"):
        open_dataset(scenes.dataset).list_scenes("people", "test")
    drawn = scenes.add_split("drawn", "random", val=0.34, test=0.34, seed=3)
    assert drawn == scenes.add_split("drawn", "random", val=0.34, test=0.34, seed=3)
    assert sorted(number for numbers in drawn.values() for number in numbers) == [0, 1, 2]
    assert [len(drawn[split]) for split in ("train", "val", "test")] == [1, 1, 1]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("s0", {"by": "random"}, "name must not be s0"),
        ("a b", {"by": "random"}, "name must be"),
        ("a", {"by": "color"}, "unknown by"),
        ("a", {"by": "person", "val": ["carl"]}, "unknown person 'carl'; valid: anna, ben"),
        ("a", {"by": "person", "val": ["ben"], "test": ["ben"]}, "must not share a name"),
        ("a", {"by": "object"}, "train split must not be empty"),
        ("a", {"by": "random", "val": 1.5}, "share from 0 to 1"),
        ("a", {"by": "random", "seed": -1}, "seed must be a whole number from 0 on, got -1"),
    ],
)
def test_wrong_splits(scenes: CustomSceneFolder, name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(HandoverError, match=message):
        scenes.add_split(name, **options)


def test_objects_are_added_once(scenes: CustomSceneFolder) -> None:
    with pytest.raises(OptionError, match="name must be new, got 'box'"):
        scenes.add_object("box", make_box(), grasps=0)


def test_grasps_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    folders = [tmp_path / str(workers) / "boxes" for workers in (1, 2)]
    for workers, folder in enumerate(folders, start=1):
        config = MeshConfig(concavity=1.0)
        CustomSceneFolder(folder).add_object("box", make_box(), config, grasps=3, workers=workers, progress=False)
    assert list_files(folders[0]) == list_files(folders[1])


def test_missing_files_are_named(scenes: CustomSceneFolder, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(scenes.folder, folder)
    fingerprint = CustomDataset(scenes.folder).compute_fingerprint(0)
    assert CustomDataset(folder).compute_fingerprint(0) == fingerprint
    urdf = folder / "objects" / "box" / "model_normalized.urdf"
    urdf.write_text(urdf.read_text().replace("0.9", "0.8"))
    assert CustomDataset(folder).compute_fingerprint(0) != fingerprint
    (folder / "motion" / "000001.npz").unlink()
    with pytest.raises(HandoverError, match=r"000001\.npz is missing"):
        CustomSceneFolder(folder).check()


DRIFT = np.linspace(0.0, 1.0, 3001)
MOTION, GRASPS = "motion/000000", "objects/box/grasps"
#: File, array, place and value that is added in a file of arrays in the folder, and the error.
EDITS: dict[str, tuple[str, str, Any, Any, str]] = {
    "far": (MOTION, "object_dof", np.s_[1500:, 0, 0], 5.0, "object must be within 3 m of the world"),
    "jump": (MOTION, "object_dof", np.s_[1500:, 0, 0], 0.1, "object must not jump, got 100 m/s in frame 1500"),
    "spin": (MOTION, "object_dof", np.s_[1500:, 0, 3], 1.0, "object must not jump, got 1e\\+03 rad/s"),
    "degrees": (MOTION, "object_dof", np.s_[:, 0, 3], 1e4, "angles of object must be in rad"),
    "end below": (MOTION, "object_dof", np.s_[:, 0, 2], -0.5 * DRIFT, "object must end above the table"),
    "hand away": (MOTION, "hand_dof", np.s_[:, 2], 1.3, "hand must come within 1 m of the object"),
    "hand jumps": (MOTION, "hand_dof", np.s_[1000:, 0], 0.2, "the hand must not jump"),
    "fingers": (MOTION, "hand_dof", np.s_[:, 10], 7.0, "finger angles must be at most"),
    "no hand": (MOTION, "hand_span", np.s_[1], -4000, "hand_span must be frames"),
    "a hand": ("motion/000002", "hand_span", np.s_[:], 9, "hand_span must be -1"),
    "grasp away": (GRASPS, "grasps", np.s_[3, 0, 3], 1.0, r"within 0\.05 m of the object, .* grasp 3"),
    "stretched": (GRASPS, "grasps", np.s_[3, 0, 0], 0.5, "without a rotation in grasp 3"),
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
    dataset = CustomDataset(folder)
    with pytest.raises(DataFormatError, match=message):
        dataset.load_grasps("box") if "grasps" in file else dataset.load_scene(int(file[-6:]))


@pytest.mark.parametrize(
    ("name", "before", "after", "message"),
    [
        ("model_normalized.urdf", 'mass value="0.2"', 'mass value="nan"', "<mass> must be a number from 0 to 1000"),
        ("model_normalized_convex.obj", " 0.0", " 9.0", "largest extent must be 0.005 to 0.7 m"),
    ],
)
def test_impossible_models(
    name: str, before: str, after: str, message: str, scenes: CustomSceneFolder, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(scenes.folder, folder)
    path = folder / "objects" / "box" / name
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after))
    with pytest.raises(HandoverError, match=message):
        CustomSceneFolder(folder).check()


def test_configuration_of_the_frame(scenes: CustomSceneFolder) -> None:
    """A recording in the table's frame gives the same motion of object and hand as one in the world frame."""
    builder = CustomSceneFolder(scenes.folder)
    builder.add_motion(moved(BOTH, BELOW), "box", "carl", MotionConfig(frame="table"), recording="table")
    dataset = CustomDataset(scenes.folder)
    first, last = dataset.load_scene(0), dataset.load_scene(dataset.n_scenes - 1)
    np.testing.assert_allclose(last.object_dof[:, 0], first.object_dof[:, 0], atol=1e-5)
    np.testing.assert_allclose(last.hand_dof, first.hand_dof, atol=1e-4)
