"""Tests of sleeping worlds, which skip bodies that nothing can touch without changing the simulation."""

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PandaConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.mujoco.world import MujocoWorld
from tests.simulation.test_worlds import INTO_THE_HAND

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
SCENE = SyntheticDataset().load_scene(209)


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
