"""Scenes in which nothing is near the robot: what is left out must not show."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.models.panda import WAITING_JOINTS
from handover_marl.protocol.contacts import Contacts
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.sim.mujoco import lone_robot
from handover_marl.sim.mujoco.lone_robot import LoneRobot
from handover_marl.sim.mujoco.mujoco_world import MujocoWorld
from handover_marl.sim.mujoco.scene_model import scene_model
from tests.sim.mujoco.test_mujoco_world import INTO_THE_HAND

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
SCENE = SyntheticDataset().scene(209)
Look = Callable[[Episode], object]


def begun(awake: bool = False) -> tuple[Episode, MujocoWorld]:
    episode = Episode("mujoco")
    episode.reset(SCENE)
    world = episode.world
    assert isinstance(world, MujocoWorld)
    if awake:
        world._wake()
    assert world.dormant is not awake
    return episode, world


def joints(world: MujocoWorld) -> npt.NDArray[np.float64]:
    return np.concatenate([world._lane.qpos, world.exact_joints()])


def test_what_is_simulated_from_the_start_on_goes_the_same_way() -> None:
    (dormant, own), (awake, other) = begun(), begun(awake=True)
    stages = set()
    for target in (WAITING, WAITING, START + np.float32(0.1), INTO_THE_HAND):
        for _ in range(10):
            for episode in (dormant, awake):
                episode.advance(target, 97)
            if dormant.status or awake.status:
                break
            stages.add(own.dormant)
            # As near as the engine's servos lead objects: metres, and radians.
            ways = own.object_dof() - other.object_dof()
            assert np.abs(ways[:, :3]).max() < 2e-4
            assert np.abs(ways[:, 3:]).max() < 3e-3
            np.testing.assert_allclose(own.exact_joints(), other.exact_joints(), atol=1e-6)
            speeds = [world.state().robot_joint_velocity for world in (own, other)]
            np.testing.assert_allclose(*speeds, atol=1e-4)
    assert stages == {True, False}
    assert dormant.status == awake.status != EpisodeStatus.RUNNING
    assert abs(dormant.steps - awake.steps) <= 5


@pytest.mark.parametrize("steps", [1, 7, 50, 400])
def test_it_does_not_matter_how_steps_are_divided(steps: int) -> None:
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
                slept += world.dormant
            states.append(joints(world))
        assert slept
        assert not world.dormant
        found.append([*states, np.array([episode.steps, episode.status])])
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(one, same)


def test_an_object_goes_on_as_fast_as_it_was_led() -> None:
    """Woken in the middle of its way it must not be thrown or stopped."""
    episode, world = begun()
    while np.abs(world._lane.qvel[world._lane.scene.object_qvel]).max() == 0.0:
        episode.advance(START, 50)
        before = world.object_dof()[0]
        episode.advance(START, 1)
        if np.abs(world.object_dof()[0] - before)[:3].max() > 2e-4:
            world._wake()
    speeds = world._lane.qvel[world._lane.scene.object_qvel][:3]
    assert np.linalg.norm(speeds) > 0.2
    now = world.object_dof()[0, :3]
    episode.advance(START, 1)
    np.testing.assert_allclose((world.object_dof()[0, :3] - now) / 0.001, speeds, atol=0.02)


def test_nothing_touches_and_a_release_wakes() -> None:
    episode, world = begun()
    episode.advance(START, 20)
    assert world.contacts(released=False) == Contacts() == episode.contacts
    world.release_target()
    episode.advance(START, 1)
    assert not world.dormant
    assert episode.steps == 21


@pytest.fixture
def robot() -> LoneRobot:
    return LoneRobot(scene_model(SCENE.assets, PhysicsConfig()).stage)


def test_a_robot_is_simulated_once_for_each_way(robot: LoneRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lone_robot, "_REMEMBERED", 2)
    simulated, simulate = [], robot._simulated
    monkeypatch.setattr(robot, "_simulated", lambda *given: simulated.append(given) or simulate(*given))
    start, target = robot.start(START), WAITING.tolist()
    first = robot.go_on(start, 0, target, 100, 0)
    assert robot.go_on(robot.start(START), 0, target, 100, 900) is first
    assert len(simulated) == 1
    parted = robot.go_on(first, 60, target, 40, 60)
    np.testing.assert_array_equal(parted.joints, first.joints[60:])
    np.testing.assert_array_equal(parted.warm, first.warm[60:])
    robot.go_on(start, 0, START.tolist(), 100, 0)
    assert len(simulated) == 3
    again = robot.go_on(start, 0, target, 100, 0)
    assert len(simulated) == 4, "the oldest way was forgotten"
    np.testing.assert_array_equal(again.joints, first.joints)


def test_balls_are_around_the_links_where_they_are(robot: LoneRobot) -> None:
    path = robot.go_on(robot.start(START), 0, WAITING.tolist(), 300, 0)
    moved = np.abs(path.balls[-1] - path.balls[0]).max()
    assert 0.1 < moved < 1.0
    assert path.balls.shape[0] == 300
    assert path.joints.shape == path.speeds.shape == (301, 9)
