"""Tests of MuJoCo's physics against fast physics, of sleeping worlds, and of contact sensors."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from handover_marl.geometry.panda import FINGER_LINKS, WAITING_JOINTS
from handover_marl.simulation.bullet.exact_and_fast import FastWorld
from handover_marl.simulation.mujoco.engine import check_warnings
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model
from handover_marl.simulation.mujoco.world import MujocoWorld
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import Contacts, World
from tests.simulation.test_worlds import INTO_THE_HAND

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
SCENE = SyntheticDataset().load_scene(209)
CONFIG = PhysicsConfig()


def hold(objects: npt.NDArray[np.float32], steps: int) -> ReferenceMotion:
    """Return a motion of some steps in which objects stay at joint positions (1, m, 6), without a hand."""
    return ReferenceMotion(
        np.repeat(objects, steps, axis=0), np.zeros((steps, 51), np.float32), np.zeros(steps, dtype=bool)
    )


@pytest.fixture
def worlds() -> Iterator[tuple[World, World]]:
    both = FastWorld(CONFIG), MujocoWorld(CONFIG)
    yield both
    for world in both:
        world.close()


def move_robot(world: World, target: npt.NDArray[np.float32], steps: int) -> npt.NDArray[np.float64]:
    """Return the robot's joint positions (n, 9) after each step towards a target from the start."""
    world.reset(SCENE, hold(SCENE.object_dof[:1], 1), CONFIG.panda.start_joints)
    world.set_reference(hold(SCENE.object_dof[:1], steps))
    path = []
    for _ in range(steps):
        world.step(target.tolist())
        path.append(world.read_joints_float64())
    return np.array(path)


def test_robot_motors_move_as_in_bullet(worlds: tuple[World, World]) -> None:
    target = START + np.array([0.3] * 7 + [-0.01, -0.02], dtype=np.float32)
    fast, own = (move_robot(world, target, 400) for world in worlds)
    away = np.abs(own - fast)
    assert away[:, :7].max() < 8e-3, "rad, at any time"
    assert away[:, 7:].max() < 2e-3, "m, at any time"
    assert away[-1].max() < 2e-3
    assert np.abs(fast[0] - fast[-1]).max() > 0.27, "it did move"


def test_targets_are_clipped_to_joint_limits(worlds: tuple[World, World]) -> None:
    beyond, within = START.copy(), START.copy()
    limits = read_urdf_links(SCENE.assets.panda, read_tree(SCENE.assets.panda))[0].limits
    assert limits is not None
    beyond[0], within[0] = 6.0, limits[1]
    for world in worlds:
        paths = [move_robot(world, target, 100) for target in (beyond, within)]
        np.testing.assert_allclose(*paths, atol=1e-4)
        assert paths[0][-1, 0] > 1.0, "it did move"


def test_released_objects_fall_onto_the_table() -> None:
    world, place = MujocoWorld(CONFIG), SCENE.object_dof[:1].copy()
    place[0, 0, 2] += 0.1
    world.reset(SCENE, hold(place, 1), CONFIG.panda.start_joints)
    world.set_reference(hold(place, 700))
    for _ in range(50):
        world.step(START.tolist())
        assert not world.read_contacts(released=False).robot_touches_object
    held = world.read_state().object_poses[0, 2]
    assert held == pytest.approx(place[0, 0, 2], abs=1e-4)
    world.release_target()
    heights, supported = [], []
    for _ in range(600):
        world.step(START.tolist())
        contacts = world.read_contacts(released=True)
        heights.append(contacts.object_height)
        supported.append(contacts.object_supported)
    fallen = held - np.array(heights[:100])
    np.testing.assert_allclose(fallen, 4.9 * (0.001 * np.arange(1, 101)) ** 2, atol=1e-3)
    assert not supported[50]
    assert supported[-1]
    assert 0.92 < heights[-1] < held
    np.testing.assert_allclose(world.read_joint_snapshot().objects[1:, :3], place[0, 1:, :3], atol=1e-3)


@pytest.mark.parametrize("what", ["qpos", "target"])
def test_a_state_that_is_not_finite_raises_an_error(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    episode, world = start()
    episode.advance(START, 10)
    target = START.copy()
    if what == "target":
        target[2] = np.nan
    else:
        world.wake()
        world.data.qpos[2] = np.nan
    with pytest.raises(SimulationError, match=r"failed: .*Nan"):
        episode.advance(target, 10)
    assert list(tmp_path.iterdir()) == [], "no log in the working folder"
    assert "WARNING" not in capfd.readouterr().err
    episode.reset(SCENE)
    episode.advance(START, 10)
    assert np.isfinite(world.read_joints_float64()).all(), "after a reset all is well"


def start() -> tuple[Episode, MujocoWorld]:
    episode = Episode("mujoco")
    episode.reset(SCENE)
    assert isinstance(episode.world, MujocoWorld)
    return episode, episode.world


def test_sleeping_worlds_move_as_awake_ones() -> None:
    (asleep, own), (awake, other) = start(), start()
    other.wake()
    stages = set()
    for target in (WAITING, WAITING, START + np.float32(0.1), INTO_THE_HAND):
        for _ in range(10):
            for episode in (asleep, awake):
                episode.advance(target, 97)
            if asleep.status or awake.status:
                break
            stages.add(own.sleep_state is not None)
            # Tolerances (m, then rad) are the errors with which MuJoCo's actuators follow the reference.
            ways = own.read_joint_snapshot().objects - other.read_joint_snapshot().objects
            assert np.abs(ways[:, :3]).max() < 2e-4
            assert np.abs(ways[:, 3:]).max() < 3e-3
            np.testing.assert_allclose(own.read_joints_float64(), other.read_joints_float64(), atol=1e-6)
            speeds = [world.read_state().robot_joint_velocity for world in (own, other)]
            np.testing.assert_allclose(*speeds, atol=1e-4)
    assert stages == {True, False}
    assert asleep.status == awake.status != EpisodeStatus.RUNNING
    assert abs(asleep.steps - awake.steps) <= 5


def test_woken_objects_keep_their_velocity() -> None:
    """An object that wakes while it moves must neither jump nor stop."""
    episode, world = start()
    while np.abs(world.data.qvel[world.data.scene.object_qvel]).max() == 0.0:
        episode.advance(START, 50)
        before = world.read_joint_snapshot().objects[0]
        episode.advance(START, 1)
        if np.abs(world.read_joint_snapshot().objects[0] - before)[:3].max() > 2e-4:
            world.wake()
    speeds = world.data.qvel[world.data.scene.object_qvel][:3]
    assert np.linalg.norm(speeds) > 0.2
    now = world.read_joint_snapshot().objects[0, :3]
    episode.advance(START, 1)
    np.testing.assert_allclose((world.read_joint_snapshot().objects[0, :3] - now) / 0.001, speeds, atol=0.02)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return load_scene_model(SyntheticDataset().load_scene(86).assets, PhysicsConfig())


def read_contacts(scene: SceneModel, data: "mujoco.MjData") -> Contacts:
    return scene.contact_sensors.compute_contacts(data.sensordata, data.qpos, True)


def place_objects(scene: SceneModel) -> "mujoco.MjData":
    """Return a state in which hand and objects are far from the robot."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.robot_qpos] = data.ctrl[scene.robot_ctrl] = WAITING_JOINTS
    data.mocap_pos[scene.hand] = (0.0, 0.0, -10.0)
    poses, targets = data.qpos[scene.object_qpos].reshape(-1, 7), data.ctrl[scene.object_ctrl].reshape(-1, 6)
    for number in range(len(poses)):
        poses[number, :3] = targets[number, :3] = (5.0, float(number), 1.0)
    mujoco.mj_step(scene.model, data)
    return data


@pytest.fixture(scope="module")
def grasp(scene: SceneModel) -> "mujoco.MjData":
    """Return a state in which the fingers press on the object that is held between them."""
    data = place_objects(scene)
    fingers = [scene.model.body(name).id for name in FINGER_LINKS]
    between = data.xpos[fingers].mean(axis=0) + 0.04 * data.xmat[scene.gripper].reshape(3, 3)[:, 2]
    first, motors = scene.object_qpos.start, scene.object_ctrl.start
    data.qpos[first : first + 3] = data.ctrl[motors : motors + 3] = between
    data.ctrl[scene.robot_ctrl.stop - 2 : scene.robot_ctrl.stop] = 0.0
    for _ in range(300):
        mujoco.mj_step(scene.model, data)
    return data


def list_forces(scene: SceneModel, data: "mujoco.MjData", bodies: object) -> list[tuple[set[int], float]]:
    """Return both bodies and the normal force of each contact with any of some bodies."""
    found, force = [], np.zeros(6)
    for number in range(data.ncon):
        pair = {int(scene.model.geom_bodyid[geom]) for geom in data.contact[number].geom}
        if np.isin([*pair], bodies).any():
            mujoco.mj_contactForce(scene.model, data, number, force)
            found.append((pair, float(force[0])))
    return found


def test_sensors_agree_with_the_engines_contacts(scene: SceneModel, grasp: "mujoco.MjData") -> None:
    contacts, forces = read_contacts(scene, grasp), list_forces(scene, grasp, scene.objects[0])
    assert contacts.robot_object_force == pytest.approx(sum(force for _, force in forces))
    assert contacts.robot_object_force > 10.0
    assert not contacts.robot_touches_hand
    assert not contacts.object_supported
    for finger, points in zip(FINGER_LINKS, contacts.finger_points, strict=True):
        assert len(points) == sum(scene.model.body(finger).id in pair for pair, _ in forces) > 0
        # The points lie on the pads, within their depth.
        assert (np.abs(points[:, :2]) < (0.012, 0.009)).all()
        assert ((points[:, 2] > 0.0) & (points[:, 2] < 0.056)).all()


def test_hand_and_other_objects_are_sensed(scene: SceneModel) -> None:
    data = place_objects(scene)
    assert read_contacts(scene, data)._replace(object_height=0.0, gripper_position=(0.0,) * 3) == Contacts(
        object_height=0.0, gripper_position=(0.0,) * 3
    )
    data.mocap_pos[scene.hand.stop - 3 : scene.hand.stop] = data.xpos[scene.gripper]
    mujoco.mj_step(scene.model, data)
    forces = list_forces(scene, data, np.flatnonzero(scene.model.body_mocapid >= scene.hand.start))
    assert len(forces) > 3
    assert read_contacts(scene, data).robot_hand_force == pytest.approx(sum(force for _, force in forces))
    data = place_objects(scene)
    data.qpos[scene.object_qpos].reshape(-1, 7)[-1, :3] = data.xpos[scene.gripper]
    mujoco.mj_step(scene.model, data)
    contacts = read_contacts(scene, data)
    assert contacts.robot_touches_others
    assert contacts.robot_object_force == 0.0


def test_a_warning_in_any_world_of_a_batch_raises_an_error() -> None:
    batch: Any = SimpleNamespace(warning=np.zeros((3, len(mujoco.mjtWarning.__members__), 2), dtype=np.int32))
    batch.warning[2, int(mujoco.mjtWarning.mjWARN_BADQACC), 1] = 1
    check_warnings(batch, 2)
    with pytest.raises(SimulationError, match="failed"):
        check_warnings(batch, 3)
