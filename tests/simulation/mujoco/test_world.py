"""Tests of MuJoCo's physics against fast physics on synthetic scenes."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco")

from handover_marl import receivers
from handover_marl.config import CameraConfig, PandaConfig, PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, ResetNeededError, SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.simulation.bullet.fast_world import FastWorld
from handover_marl.simulation.contacts import Contacts
from handover_marl.simulation.engines import make_world
from handover_marl.simulation.mujoco.batches.simulation import WorldData
from handover_marl.simulation.mujoco.world import MujocoWorld
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import World
from tests.playing import play

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
DATA = SyntheticDataset()
SCENE = DATA.load_scene(209)
CONFIG = PhysicsConfig()
#: Joint positions with which the robot is in the hand's way in this scene.
INTO_THE_HAND = np.array([0.285, -0.182, -0.074, -2.037, -0.538, 2.359, 0.688, 0.04, 0.04], dtype=np.float32)
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


def test_objects_follow_the_reference_as_in_bullet() -> None:
    episodes = Episode("fast"), Episode("mujoco")
    for episode in episodes:
        episode.reset(SCENE)
    for steps in (0, 1, 700, 900):
        for episode in episodes:
            episode.advance(START, steps)
        fast, own = (episode.world for episode in episodes)
        np.testing.assert_allclose(own.read_object_joints(), fast.read_object_joints(), atol=2e-4)
        np.testing.assert_allclose(own.read_state().object_poses, fast.read_state().object_poses, atol=2e-4)
        np.testing.assert_array_equal(own.read_agent_joints().hand, fast.read_agent_joints().hand)
        ours, theirs = own.read_state().hand_keypoints, fast.read_state().hand_keypoints
        assert (ours is None) == (theirs is None)
        if ours is not None and theirs is not None:
            np.testing.assert_allclose(ours, theirs, atol=1e-6)


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


def episode_states(episode: Episode, scene_id: int, looks: int) -> list[npt.NDArray[np.float64]]:
    """Return robot joints, qpos and qvel after every 400 steps of an episode that is observed every `looks` steps."""
    episode.reset(DATA.load_scene(scene_id))
    world, states = world_of(episode), []
    targets = [WAITING, START + np.float32(0.2), START]
    for number in range(2400 // looks):
        episode.advance(targets[number * looks // 800], looks)
        episode.observe()
        if (number + 1) * looks % 400 == 0:
            data = world.data
            states.append(np.concatenate([world.read_joints_float64(), data.qpos, data.qvel]))
    return states


def test_whole_rollouts_are_equal_to_the_bit() -> None:
    fresh = episode_states(Episode("mujoco"), 209, 100)
    used = Episode("mujoco")
    played = episode_states(used, 209, 100)
    np.testing.assert_array_equal(played, fresh)
    # Before the next rollout, another scene is played to its end, and the object of the first scene is released.
    play(used, DATA.load_scene(14), receivers.make("yang2021", DATA))
    used.reset(SCENE)
    world_of(used).release_target()
    used.advance(WAITING, 300)
    np.testing.assert_array_equal(episode_states(used, 209, 100), fresh)
    np.testing.assert_array_equal(episode_states(used, 209, 50), fresh, "looking more often changes nothing")


def test_rendering_does_not_change_the_simulation() -> None:
    plain, looked = Episode("mujoco"), Episode("mujoco")
    for episode in (plain, looked):
        episode.reset(SCENE)
        episode.advance(START, 800)
    assert looked.render(CameraConfig(width=80, height=60)).std() > 10.0
    photo = looked.world.render_wrist_camera(None, True)
    assert photo.depth.shape == (224, 224)
    for episode in (plain, looked):
        episode.advance(WAITING, 200)
    np.testing.assert_array_equal(plain.world.read_joints_float64(), looked.world.read_joints_float64())


@pytest.mark.parametrize("scene_id", [14, 34])
def test_episodes_of_yang_end_as_in_fast_physics(scene_id: int) -> None:
    receiver, own, fast = receivers.make("yang2021", DATA), Episode("mujoco"), Episode("fast")
    for episode in (own, fast):
        play(episode, DATA.load_scene(scene_id), receiver)
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


def test_no_window_and_no_step_before_reset() -> None:
    with pytest.raises(OptionError, match="opens no window"):
        make_world("mujoco", CONFIG, window=True)
    with pytest.raises(ResetNeededError):
        MujocoWorld(CONFIG).step(START.tolist())


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
