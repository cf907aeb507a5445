"""Tests that every engine passes: repeated episodes, division of steps, images, and agreement with exact physics."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl import givers, receivers
from handover_marl.config import CameraConfig, PandaConfig, PhysicsConfig
from handover_marl.datasets import OfficialDataset, open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.policies.policy import Action
from handover_marl.simulation.bullet.fast_world import FastWorld
from handover_marl.simulation.engines import PHYSICS, make_world

START = np.array(PandaConfig().start_joints, dtype=np.float32)
WAITING = np.array(WAITING_JOINTS, dtype=np.float32)
#: Joint positions with which the robot is in the hand's way in scene 209.
INTO_THE_HAND = np.array([0.285, -0.182, -0.074, -2.037, -0.538, 2.359, 0.688, 0.04, 0.04], dtype=np.float32)
DATA = open_dataset("synthetic", robot="panda_camera")


@pytest.fixture(params=PHYSICS)
def physics(request: pytest.FixtureRequest) -> str:
    if request.param == "mujoco":
        pytest.importorskip("mujoco")
    return str(request.param)


@pytest.fixture
def episodes() -> Iterator[list[Episode]]:
    """Yield a list of episodes, which are closed at the end."""
    made: list[Episode] = []
    yield made
    for episode in made:
        episode.close()


class Motion(EpisodeCallback):
    """Callback that records the joint positions of robot and objects after every step."""

    def on_reset(self, episode: Episode) -> None:
        self.rows: list[npt.NDArray[np.float32]] = []

    def on_step(self, episode: Episode) -> None:
        world = episode.world
        self.rows.append(np.concatenate([world.read_agent_joints().robot, world.read_object_joints().ravel()]))


@pytest.mark.slow
def test_a_used_world_equals_a_new_one(physics: str, episodes: list[Episode]) -> None:
    """Episodes are bit-equal after any earlier ones, so that results do not depend on the division among workers.

    `yang2021` grasps the object, which is released; the random receiver hits itself, the table and the objects.
    """

    def play(episode: Episode, receiver: str, giver: str, scene_id: int) -> tuple[Any, ...]:
        motion = Motion()
        episode.reset(DATA.load_scene(scene_id))
        players = receivers.make(receiver, DATA), givers.make(giver, DATA)
        until = 2000 if receiver == "random" else None
        run_episode(episode, *players, seed=0, until=until, callbacks=[motion])
        return (episode.status, episode.steps, episode.release_step), np.array(motion.rows), episode.observe()

    episodes += [Episode(physics), Episode(physics)]
    used, new = episodes
    grasping, hitting = ("yang2021", "replay", 34), ("random", "noisy", 209)
    expected = {grasping: play(used, *grasping), hitting: play(new, *hitting)}
    assert expected[grasping][0][2] is not None, "the object was released"
    for played in (hitting,) if physics == "exact" else (hitting, grasping):
        end, rows, seen = play(used, *played)
        assert end == expected[played][0]
        np.testing.assert_array_equal(rows, expected[played][1])
        for key, value in seen.items():
            np.testing.assert_array_equal(value, expected[played][2][key], err_msg=key)


@pytest.mark.slow
def test_division_of_steps_and_images_change_nothing(physics: str, episodes: list[Episode]) -> None:
    """States are those of long rollouts, whoever looks in between, until the robot touches the hand."""
    scene, camera = DATA.load_scene(209), CameraConfig(width=32, height=24)
    found = []
    for size, is_watched in ((200, False), (7, False), (50, True)):
        episode = Episode(physics)
        episodes.append(episode)
        episode.reset(scene)
        earlier, states = episode.world.read_joint_snapshot(), []
        for target in (WAITING, START + np.float32(0.05), INTO_THE_HAND):
            left = 800
            while left and not episode.status:
                episode.advance(target, min(size, left), on_step=[lambda one: one.observe()] if is_watched else [])
                left -= min(size, left)
                if is_watched and left % 400 == 0:
                    assert episode.render(camera).std() > 10.0
                    assert episode.world.render_wrist_camera(None, True).segmentation.any()
                    episode.world.render_wrist_camera(earlier, False)
            states.append(np.concatenate([episode.world.read_joints_float64(), *episode.world.read_object_joints()]))
        assert episode.status == EpisodeStatus.HUMAN_CONTACT
        assert episode.steps == pytest.approx(2280, abs=5), "all engines find the contact"
        found.append((episode.steps, states))
    # In fast physics, the time at which bodies near each other wake depends on the division.
    tolerances = (2e-6, 2e-6, 5e-3) if physics == "fast" else (0.0, 0.0, 0.0)
    for steps, other in found[1:]:
        assert steps == found[0][0]
        for one, same, tolerance in zip(found[0][1], other, tolerances, strict=True):
            np.testing.assert_allclose(same, one, rtol=0.0, atol=tolerance)


#: Largest differences from exact physics by engine: of arrays without an entry in `MOTION`, and of objects' poses.
TOLERANCES = {"fast": (1e-6, 1e-5), "mujoco": (2e-4, 2e-4)}
#: Largest differences of arrays whose bodies follow the recording by motors in exact physics.
MOTION = {"hand_dof_position": 1e-2, "hand_keypoints": 1e-3}


@pytest.mark.slow
@pytest.mark.parametrize("name", TOLERANCES)
@pytest.mark.parametrize("data", ["synthetic", "coming and going"])
def test_states_are_those_of_exact_physics(name: str, data: str, fake_data: Path, episodes: list[Episode]) -> None:
    """States are equal while the robot is far from all bodies, also if the hand appears and disappears."""
    if name == "mujoco":
        pytest.importorskip("mujoco")
    scene = DATA.load_scene(209) if data == "synthetic" else OfficialDataset(fake_data).load_scene(14)
    episodes += [Episode("exact"), Episode(name)]
    for episode in episodes:
        episode.reset(scene)
    presence = []
    for steps in (0, 1, 59, 40, 300, 100, 500, 1000, 1000) if data == "synthetic" else [10] * 45:
        seen = []
        for episode in episodes:
            episode.advance(START, steps)
            seen.append(episode.observe())
        for key, exact in seen[0].items():
            atol = MOTION.get(key, TOLERANCES[name][key == "object_poses"] if data == "synthetic" else 1e-3)
            np.testing.assert_allclose(seen[1][key], exact, rtol=0, atol=atol, err_msg=f"{key} at {episode.steps}")
        presence.append(bool(seen[0]["hand_present"]))
    assert {*presence} == {True, False}
    world = episodes[1].world
    if isinstance(world, FastWorld) and data == "synthetic":
        assert world._hand is not None
        assert not world._hand.bodies, "nothing was near"
        assert not any(item.is_awake for item in world._objects)


@pytest.mark.slow
@pytest.mark.parametrize("frame", [0, 1500])
def test_images_are_alike(frame: int, episodes: list[Episode]) -> None:
    pictures = []
    for physics in ("exact", "fast"):
        episodes.append(Episode(physics))
        episodes[-1].reset(DATA.load_scene(209))
        episodes[-1].advance(START, frame)
        pictures.append(episodes[-1].render(CameraConfig(width=160, height=120)).astype(int))
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 40).mean() < 0.002


def load_late_scene(scene_id: int, first: int = 2300) -> Scene:
    """Return a scene that begins late in its recording, when the hand holds out the object."""
    scene = DATA.load_scene(scene_id)
    assert scene.hand_last == scene.n_frames - 1, "the hand stays"
    motion = {"object_dof": scene.object_dof[first:], "hand_dof": scene.hand_dof[first:]}
    return replace(scene, **motion, hand_first=0, hand_last=scene.hand_last - first)


def throw(physics: str, scene: Scene, targets: list[Action]) -> tuple[EpisodeStatus, int]:
    """Return status and steps after the arm was driven to two joint targets in turn."""
    episode = Episode(physics)
    episode.reset(scene)
    episode.advance(START, 100)
    for target, steps in zip(targets, (250, 500), strict=True):
        episode.advance(target, steps)
    episode.close()
    return episode.status, episode.steps


@pytest.mark.slow
@pytest.mark.parametrize(("scene_id", "seed", "touches"), [(8, 4, True), (53, 19, True), (5, 4, False)])
def test_no_contact_with_the_hand_is_missed(scene_id: int, seed: int, touches: bool) -> None:
    """An arm that moves to random joint positions touches the hand in both engines, at most 3 steps apart."""
    rng, lower, upper = np.random.default_rng(seed), np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
    targets = []
    for _ in range(2):
        target = START.copy()
        target[:7] = lower[:7] + rng.uniform(0.2, 0.8, 7) * (upper - lower)[:7]
        targets.append(target)
    exact, fast = (throw(physics, load_late_scene(scene_id), targets) for physics in ("exact", "fast"))
    assert bool(exact[0] & EpisodeStatus.HUMAN_CONTACT) == touches
    assert bool(fast[0] & EpisodeStatus.HUMAN_CONTACT) == touches
    assert abs(exact[1] - fast[1]) <= 3


def test_only_pybullet_has_a_window() -> None:
    pytest.importorskip("mujoco")
    with pytest.raises(OptionError, match="opens no window"):
        make_world("mujoco", PhysicsConfig(), window=True)
