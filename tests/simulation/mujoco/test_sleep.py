"""Tests of sleeping worlds, which skip bodies that nothing can touch without changing the simulation."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.mujoco import sleep
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.sleep import RobotOnlySimulation
from handover_marl.simulation.mujoco.world import MujocoWorld
from tests.simulation.mujoco.test_world import INTO_THE_HAND

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
SCENE = SyntheticDataset().load_scene(209)
Look = Callable[[Episode], object]


def begun(awake: bool = False) -> tuple[Episode, MujocoWorld]:
    episode = Episode("mujoco")
    episode.reset(SCENE)
    world = episode.world
    assert isinstance(world, MujocoWorld)
    if awake:
        world.wake()
    assert world.is_asleep is not awake
    return episode, world


def joints(world: MujocoWorld) -> npt.NDArray[np.float64]:
    return np.concatenate([world.data.qpos, world.read_joints_float64()])


def test_sleeping_worlds_move_as_awake_ones() -> None:
    (asleep, own), (awake, other) = begun(), begun(awake=True)
    stages = set()
    for target in (WAITING, WAITING, START + np.float32(0.1), INTO_THE_HAND):
        for _ in range(10):
            for episode in (asleep, awake):
                episode.advance(target, 97)
            if asleep.status or awake.status:
                break
            stages.add(own.is_asleep)
            # Tolerances (m, then rad) are the errors with which MuJoCo's actuators follow the reference.
            ways = own.read_object_joints() - other.read_object_joints()
            assert np.abs(ways[:, :3]).max() < 2e-4
            assert np.abs(ways[:, 3:]).max() < 3e-3
            np.testing.assert_allclose(own.read_joints_float64(), other.read_joints_float64(), atol=1e-6)
            speeds = [world.read_state().robot_joint_velocity for world in (own, other)]
            np.testing.assert_allclose(*speeds, atol=1e-4)
    assert stages == {True, False}
    assert asleep.status == awake.status != EpisodeStatus.RUNNING
    assert abs(asleep.steps - awake.steps) <= 5


@pytest.mark.parametrize("steps", [1, 7, 50, 400])
def test_results_do_not_depend_on_the_division_of_steps(steps: int) -> None:
    def look(episode: Episode) -> None:
        episode.observe()

    found = []
    for size, watched in ((200, False), (steps, False), (steps, True)):
        episode, world = begun()
        states, slept = [], 0
        for target in (WAITING, START + np.float32(0.05), INTO_THE_HAND):
            left = 800
            while left and not episode.status:
                episode.advance(target, min(size, left), on_step=[look] if watched else [])
                left -= min(size, left)
                slept += world.is_asleep
            states.append(joints(world))
        assert slept
        assert not world.is_asleep
        found.append([*states, np.array([episode.steps, episode.status])])
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(one, same)


def test_woken_objects_keep_their_velocity() -> None:
    """An object that wakes while it moves must neither jump nor stop."""
    episode, world = begun()
    while np.abs(world.data.qvel[world.data.scene.object_qvel]).max() == 0.0:
        episode.advance(START, 50)
        before = world.read_object_joints()[0]
        episode.advance(START, 1)
        if np.abs(world.read_object_joints()[0] - before)[:3].max() > 2e-4:
            world.wake()
    speeds = world.data.qvel[world.data.scene.object_qvel][:3]
    assert np.linalg.norm(speeds) > 0.2
    now = world.read_object_joints()[0, :3]
    episode.advance(START, 1)
    np.testing.assert_allclose((world.read_object_joints()[0, :3] - now) / 0.001, speeds, atol=0.02)


def test_sleeping_worlds_have_no_contacts_and_a_release_wakes_them() -> None:
    episode, world = begun()
    episode.advance(START, 20)
    assert world.read_contacts(released=False) == Contacts() == episode.contacts
    world.release_target()
    episode.advance(START, 1)
    assert not world.is_asleep
    assert episode.steps == 21


@pytest.fixture
def robot() -> RobotOnlySimulation:
    return RobotOnlySimulation(load_scene_model(SCENE.assets, PhysicsConfig()).robot_only)


def test_equal_rollouts_of_the_robot_are_simulated_once(
    robot: RobotOnlySimulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sleep, "_CACHE_SIZE", 2)
    simulated, simulate = [], robot._simulate
    monkeypatch.setattr(robot, "_simulate", lambda *given: simulated.append(given) or simulate(*given))
    start, target = robot.make_resting_trajectory(START), WAITING.tolist()
    first = robot.simulate(start, 0, target, 100)
    assert robot.simulate(robot.make_resting_trajectory(START), 0, target, 100) is first
    assert len(simulated) == 1
    parted = robot.simulate(first, 60, target, 40)
    np.testing.assert_array_equal(parted.joints, first.joints[60:])
    np.testing.assert_array_equal(parted.warm_start, first.warm_start[60:])
    robot.simulate(start, 0, START.tolist(), 100)
    assert len(simulated) == 3
    again = robot.simulate(start, 0, target, 100)
    assert len(simulated) == 4, "the oldest rollout was dropped from the cache"
    np.testing.assert_array_equal(again.joints, first.joints)


def test_bounding_spheres_move_with_the_links(robot: RobotOnlySimulation) -> None:
    path = robot.simulate(robot.make_resting_trajectory(START), 0, WAITING.tolist(), 300)
    moved = np.abs(path.sphere_centers[-1] - path.sphere_centers[0]).max()
    assert 0.1 < moved < 1.0
    assert path.sphere_centers.shape[0] == 300
    assert path.joints.shape == path.velocities.shape == (301, 9)
