"""Tests of MuJoCo's physics against fast physics on synthetic scenes."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco")

from handover_marl import receivers
from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.simulation.bullet.fast_world import FastWorld
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.mujoco.batches.simulation import WorldData
from handover_marl.simulation.mujoco.world import MujocoWorld
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import World
from tests.playing import play
from tests.simulation.test_worlds import INTO_THE_HAND

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
DATA = SyntheticDataset()
SCENE = DATA.load_scene(209)
CONFIG = PhysicsConfig()
NOTHING = Contacts(object_height=0.0, gripper_position=(0.0,) * 3)


def world_of(episode: Episode) -> MujocoWorld:
    assert isinstance(episode.world, MujocoWorld)
    return episode.world


def lying(steps: int) -> ReferenceMotion:
    """Return a motion of some steps in which objects stay at their first poses, without a hand."""
    return ReferenceMotion(
        np.repeat(SCENE.object_dof[:1], steps, axis=0), np.zeros((steps, 51), np.float32), np.zeros(steps, dtype=bool)
    )


@pytest.fixture
def worlds() -> Iterator[tuple[World, World]]:
    both = FastWorld(CONFIG), MujocoWorld(CONFIG)
    for world in both:
        world.reset(SCENE, lying(1), CONFIG.panda.start_joints)
    yield both
    for world in both:
        world.close()


def joints_over(world: World, target: npt.NDArray[np.float32], steps: int) -> npt.NDArray[np.float64]:
    world.set_reference(lying(steps))
    path = []
    for _ in range(steps):
        world.step(target.tolist())
        path.append(world.read_joints_float64())
    return np.array(path)


@pytest.mark.parametrize(("change", "most"), [(0.05, 1.5e-3), (0.3, 8e-3)])
def test_robot_motors_move_as_in_bullet(worlds: tuple[World, World], change: float, most: float) -> None:
    target = START + np.array([change] * 7 + [-0.01, -0.02], dtype=np.float32)
    fast, own = (joints_over(world, target, 400) for world in worlds)
    away = np.abs(own - fast)
    assert away[:, :7].max() < most, "rad, at any time"
    assert away[:, 7:].max() < 2e-3, "m, at any time"
    assert away[-1].max() < 2e-3
    assert np.abs(fast[0] - fast[-1]).max() > 0.9 * change, "it did move"


@pytest.mark.parametrize("kind", [FastWorld, MujocoWorld])
def test_targets_are_clipped_to_joint_limits(kind: Callable[[PhysicsConfig], World]) -> None:
    beyond, within = START.copy(), START.copy()
    limits = read_urdf_links(SCENE.assets.panda, read_tree(SCENE.assets.panda))[0].limits
    assert limits is not None
    beyond[0], within[0] = 6.0, limits[1]
    paths = []
    for target in (beyond, within):
        world = kind(CONFIG)
        world.reset(SCENE, lying(1), CONFIG.panda.start_joints)
        paths.append(joints_over(world, target, 100))
        world.close()
    np.testing.assert_allclose(*paths, atol=1e-4)
    assert paths[0][-1, 0] > 1.0, "it did move"


def test_released_objects_fall_onto_the_table() -> None:
    world = MujocoWorld(CONFIG)
    place = SCENE.object_dof[:1].copy()
    place[0, 0, 2] += 0.1
    motion = ReferenceMotion(
        np.repeat(place, 1500, axis=0), np.zeros((1500, 51), np.float32), np.zeros(1500, dtype=bool)
    )
    world.reset(SCENE, ReferenceMotion(place, motion.hand[:1], motion.hand_present[:1]), CONFIG.panda.start_joints)
    world.set_reference(motion)
    for _ in range(50):
        world.step(START.tolist())
        contacts = world.read_contacts(released=False)
        assert contacts._replace(object_height=0.0, gripper_position=(0.0,) * 3) == NOTHING
    held = world.read_state().object_poses[0, 2]
    assert held == pytest.approx(place[0, 0, 2], abs=1e-4)
    world.release_target()
    heights, supported = [], []
    for _ in range(1400):
        world.step(START.tolist())
        contacts = world.read_contacts(released=True)
        heights.append(contacts.object_height)
        supported.append(contacts.object_supported)
    fallen = held - np.array(heights[:100])
    np.testing.assert_allclose(fallen, 4.9 * (0.001 * np.arange(1, 101)) ** 2, atol=1e-3)
    assert not supported[50]
    assert supported[-1]
    assert 0.92 < heights[-1] < held
    np.testing.assert_allclose(world.read_state().object_poses[1:, :3], place[0, 1:, :3], atol=1e-3)


@pytest.mark.slow
def test_episodes_of_yang_end_as_in_fast_physics() -> None:
    receiver, own, fast = receivers.make("yang2021", DATA), Episode("mujoco"), Episode("fast")
    for episode in (own, fast):
        play(episode, DATA.load_scene(34), receiver)
    assert own.status == fast.status != EpisodeStatus.RUNNING
    assert abs(own.steps - fast.steps) < 200


@pytest.mark.parametrize("what", ["qpos", "qvel", "target"])
def test_a_state_that_is_not_finite_raises_an_error(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    episode = Episode("mujoco")
    episode.reset(SCENE)
    episode.advance(START, 10)
    target = START.copy()
    if what == "target":
        target[2] = np.nan
    else:
        world_of(episode).wake()
        getattr(world_of(episode).data, what)[2] = np.nan
    with pytest.raises(SimulationError, match=r"failed: .*Nan"):
        episode.advance(target, 10)
    assert list(tmp_path.iterdir()) == [], "no log in the working folder"
    assert "WARNING" not in capfd.readouterr().err
    episode.reset(SCENE)
    episode.advance(START, 10)
    assert np.isfinite(episode.world.read_joints_float64()).all(), "after a reset all is well"


def test_ignoring_hands_out_of_reach_does_not_change_the_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """An episode that ends with contact is bit-equal to one in which the hand can collide all the time."""
    hands: set[bool] = set()
    select = WorldData.select_model

    def noted(self: WorldData, hand_collides: bool) -> object:
        hands.add(hand_collides)
        return select(self, hand_collides)

    def played() -> list[npt.NDArray[np.float32]]:
        episode, states = Episode("mujoco"), []
        episode.reset(SCENE)
        # The world is woken long before the hand comes near.
        world_of(episode).wake()
        while not episode.status and episode.steps < 6000:
            episode.advance(INTO_THE_HAND, 50)
            states += [episode.observe()["robot_joint_position"], episode.observe()["object_poses"]]
        states.append(np.array([episode.status, episode.steps], dtype=np.float32))
        return states

    monkeypatch.setattr(WorldData, "select_model", noted)
    first = played()
    assert hands == {True, False}
    monkeypatch.setattr(WorldData, "select_model", lambda self, hand_collides: select(self, True))
    for one, other in zip(first, played(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert first[-1][0] == EpisodeStatus.HUMAN_CONTACT
