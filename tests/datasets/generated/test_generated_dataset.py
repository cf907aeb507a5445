"""Tests of generated scenes, of shapes of procedural objects, and of human and robot grasps of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from handover_marl.assets.hand_model import SUBJECT_SIZES, scale_hand
from handover_marl.datasets import open_dataset
from handover_marl.datasets.generated.config import (
    FAMILY_DEFAULTS,
    OBJECT_KINDS,
    GeneratedConfig,
    find_splits,
    parse_generated_config,
)
from handover_marl.datasets.generated.dataset import FIRST_CLASS, GRASPABLE_CLASSES, GeneratedDataset, write_hand_model
from handover_marl.datasets.generated.grasps import draw_human_grasps, draw_robot_grasps
from handover_marl.datasets.generated.hands import draw_person
from handover_marl.datasets.generated.motion import MAX_SPEED, resample_fingers, resample_poses
from handover_marl.datasets.generated.random_stream import RandomStream
from handover_marl.datasets.generated.shapes import ProceduralObject, Solid, draw_object, make_surface
from handover_marl.errors import HandoverError, SceneError, UnknownNameError
from handover_marl.geometry.model_files.meshes import check_model
from tests.helpers.equality import hash_scene

pytestmark = pytest.mark.usefixtures("own_cache")
DEFAULT, HARD = "generated:n=100000,seed=7", "generated:n=1000,seed=7,family=hard"
#: First digits of the scenes' hashes: they change with the generator's version and with nothing else.
HASHES = {
    (DEFAULT, 0): "fe045b563e40300d",
    (DEFAULT, 1): "255767c1a66e28a9",
    (DEFAULT, 99_999): "7ca60f4576b38de3",
    (HARD, 0): "aeecdeb25d27a94a",
    (HARD, 17): "41169280ea81b669",
}


@pytest.mark.parametrize(("name", "scene_id"), HASHES)
def test_scenes_equal_their_checksums_and_are_complete(name: str, scene_id: int) -> None:
    dataset = open_dataset(name)
    scene = dataset.load_scene(scene_id)
    assert hash_scene(scene) == HASHES[name, scene_id]
    info = scene.info
    assert info.side == dataset.find_side(scene_id)
    assert info.object_names == tuple(dataset.object_names[number] for number in info.object_ids)
    assert len(set(info.object_ids)) == len(info.object_ids) == scene.object_dof.shape[1]
    assert scene.object_dof.dtype == scene.hand_dof.dtype == np.float32
    assert np.isfinite(scene.hand_dof).all()
    assert np.abs(np.diff(scene.object_dof[:, 0, :3], axis=0)).max() < 0.005
    assert not np.ptp(scene.object_dof[:, 1:], axis=0).any()
    assert all(path.is_file() for path in (*scene.assets.objects, scene.assets.hand, scene.assets.panda))


@pytest.mark.slow
def test_scenes_depend_on_seed_and_number_alone() -> None:
    dataset = open_dataset(DEFAULT)
    first = hash_scene(dataset.load_scene(17))
    for other in range(40, 45):
        dataset.load_info(other)
    assert hash_scene(dataset.load_scene(17)) == first
    assert hash_scene(open_dataset("generated:n=18,seed=7").load_scene(17)) == first
    assert hash_scene(open_dataset("generated:n=18,seed=8").load_scene(17)) != first
    assert hash_scene(open_dataset("generated:n=18,seed=7,left=0.4").load_scene(17)) == first


@pytest.mark.slow
def test_objects_differ_between_splits() -> None:
    dataset = GeneratedDataset("n=60,seed=1,procedural=1,objects=100")
    for scene_id in range(0, 60, 8):
        ids = dataset.load_info(scene_id).object_ids
        assert min(ids) >= FIRST_CLASS
        numbers = np.array(ids) - FIRST_CLASS
        assert (find_splits(numbers, of_objects=True) == find_splits([scene_id])).all()
    dataset = GeneratedDataset("n=10,seed=1,procedural=0")
    ids = dataset.load_info(0).object_ids
    assert ids[0] in GRASPABLE_CLASSES
    assert max(ids) < FIRST_CLASS


def test_name_opens_the_data_set_again() -> None:
    dataset = open_dataset("generated:family=hard,seed=3,n=10")
    assert dataset.name == "generated:n=10,seed=3,family=hard"
    assert open_dataset(dataset.name).config == parse_generated_config("n=10,seed=3,family=hard")
    assert dataset.compute_fingerprint(1) == open_dataset("generated:n=99,seed=3,family=hard").compute_fingerprint(1)
    with pytest.raises(SceneError, match="0 to 9"):
        dataset.load_scene(10)
    with pytest.raises(UnknownNameError):
        dataset.list_scenes("s0", "test")
    with pytest.raises(UnknownNameError):
        dataset.find_object_urdf("object_01000")


@pytest.mark.parametrize("scene_id", range(2))
def test_hard_scenes_move_and_turn_for_eight_seconds(scene_id: int) -> None:
    scene = GeneratedDataset("n=10,seed=1,family=hard").load_scene(scene_id)
    assert scene.n_frames == 8001
    keyframes = scene.object_dof[::40, 0].astype(np.float64)
    rotations = Rotation.from_euler("XYZ", keyframes[:, 3:])
    turns = np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude()) / 0.04
    # After the handover pose is reached, which takes about 3 s.
    assert 29.0 < turns[80:].max() < 91.0
    speeds = np.linalg.norm(np.diff(keyframes[:, :3], axis=0), axis=1) / 0.04
    assert speeds[80:].max() < MAX_SPEED + 0.02
    assert speeds[-4:].max() < 0.01
    # The hand holds the object in the same way all the time.
    hand = scene.hand_dof[::40].astype(np.float64)
    base = Rotation.from_euler("XYZ", hand[:, 3:6])
    offsets = rotations.inv().apply(hand[:, :3] - keyframes[:, :3])
    assert np.ptp(offsets[80:], axis=0).max() < 1e-4
    assert (rotations[80:].inv() * base[80:] * (rotations[80].inv() * base[80]).inv()).magnitude().max() < 1e-3


def test_models_can_be_loaded_and_are_written_once() -> None:
    dataset = GeneratedDataset("seed=2")
    for number in range(6):
        urdf = dataset.find_object_urdf(f"object_{number:05d}")
        check_model(urdf, n_joints=6)
    before = urdf.stat().st_mtime_ns
    assert dataset.find_object_urdf(f"object_{number:05d}") == urdf
    assert urdf.stat().st_mtime_ns == before
    assert GeneratedDataset("seed=3").find_object_urdf(f"object_{number:05d}") != urdf
    check_model(write_hand_model(draw_person(dataset.config, 3), "left"), n_joints=51)
    assert not list(urdf.parents[2].rglob("*.part"))


def test_family_sets_its_defaults() -> None:
    hard = parse_generated_config("n=5,family=hard")
    assert hard == replace(FAMILY_DEFAULTS["hard"], n=5)
    assert parse_generated_config("clutter_max=1") == GeneratedConfig(clutter_min=1, clutter_max=1)
    for family, usual in FAMILY_DEFAULTS.items():
        config = replace(usual, n=17, seed=2**32 - 1, left=0.1 + 0.2, boxes=1e-5)
        assert config.family == family
        assert parse_generated_config(config.argument) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "unknown parameter of generated scenes ''"),
        ("n=ten", "n must be a number, got 'ten'"),
        ("n=0", "n of GeneratedConfig must be an integer from 1 to 10000000, got 0"),
        ("clutter_min=3,clutter_max=2", "clutter_min of GeneratedConfig must be at most clutter_max, got 3 and 2"),
        ("sed=1", "unknown parameter of generated scenes 'sed'"),
    ],
)
def test_wrong_texts_are_refused(text: str, message: str) -> None:
    with pytest.raises(HandoverError, match=message):
        parse_generated_config(text)


@pytest.mark.parametrize("seed", range(5))
def test_rotations_between_keyframes_equal_scipy(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 4 + seed
    # The motion has large and small turns, and keyframes without a turn.
    turns = rng.normal(size=(n, 3)) * rng.choice([0.0, 0.02, 1.0], size=(n, 1))
    rotations = [Rotation.random(rng=rng)]
    for turn in turns[1:]:
        rotations.append(Rotation.from_rotvec(turn) * rotations[-1])
    keyframes, fingers, ends = Rotation.concatenate(rotations), rng.uniform(-1.0, 1.0, (n, 45)), 0.04 * np.arange(n)
    fingers[n // 2 :] = fingers[n // 2]
    times = np.linspace(0.0, ends[-1], 40 * (n - 1) + 1)
    angles = resample_poses(ends, np.zeros((n, 3)), keyframes, times)[:, 3:]
    expected = np.unwrap(Slerp(ends, keyframes)(times).as_euler("XYZ"), axis=0)
    np.testing.assert_allclose(angles, expected, atol=2.0**-23)
    joint = Slerp(ends, Rotation.from_euler("XYZ", fingers[:, 21:24]))(times).as_euler("XYZ")
    np.testing.assert_allclose(resample_fingers(ends, fingers, times)[:, 21:24], joint, atol=2.0**-23)


def draw_kind(kind: str, seed: int) -> tuple[ProceduralObject, Solid]:
    item = draw_object(RandomStream(seed), tuple(float(kind == other) for other in OBJECT_KINDS))
    return item, Solid(map(make_surface, item.parts))


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_objects_are_centered_and_graspable(kind: str) -> None:
    for seed in range(8):
        item, solid = draw_kind(kind, seed)
        low, high = solid.corners.min(axis=0), solid.corners.max(axis=0)
        assert item.kind == kind
        assert np.abs(low + high).max() < 2e-4
        assert (high - low).min() < 0.08
        assert 0.05 < (high - low).max() < 0.30
        assert len(item.up_axes) == 6
        assert sum(item.up_axes) > 0.0


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_human_hands_hold_objects(kind: str) -> None:
    (item, solid), size = draw_kind(kind, 4), SUBJECT_SIZES[5]
    for side in ("left", "right"):
        grasps = draw_human_grasps(RandomStream(1), solid, item.up_axes, size, side)
        assert grasps is not None
        assert (np.diff(grasps.wrist_distance) >= 0.0).all()
        assert grasps.touching[:, 4].all()
        assert (grasps.touching[:, :4].sum(axis=1) >= 2).all()
        assert (grasps.overlap < 0.004).all()
        # Grasps of both sides are in the object's frame, not mirrored: joints are outside, fingertips near.
        distances = solid.compute_distances(scale_hand(size, side).compute_keypoints(grasps.compute_hand_dof()))
        assert distances.min() > -0.004
        assert (distances[:, 8::4].min(axis=1) < 0.02).all()


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_robot_grasps_span_the_object(kind: str) -> None:
    _, solid = draw_kind(kind, 2)
    grasps = draw_robot_grasps(RandomStream(5), solid)
    assert 10 < len(grasps) <= 60
    rotations = grasps[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (len(grasps), 1, 1)), atol=1e-6)
    # The object is between the pads, which are outside of it.
    middle = grasps[:, None, :3, 3] + np.linspace(0.08, 0.112, 9)[:, None] * grasps[:, None, :3, 2]
    assert (solid.compute_distances(middle).min(axis=1) < 0.0).all()
    for sign in (-0.041, 0.041):
        assert (solid.compute_distances(middle + sign * grasps[:, None, :3, 0]) > 0.0).all()
