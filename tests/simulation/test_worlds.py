"""Tests that every engine passes: repeated episodes, division of steps, other worlds, and agreement between engines."""

import importlib.util
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl import givers, receivers
from handover_marl.config import CameraConfig, PandaConfig, PhysicsConfig, WorldConfig
from handover_marl.datasets import OfficialDataset, open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.episode_batch import EpisodeBatch
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.geometry.arrays import to_numpy
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.policies.policy import Action
from handover_marl.simulation.bullet.exact_and_fast import FastWorld
from handover_marl.simulation.engines import (
    PHYSICS,
    THREADS,
    WARP,
    BatchBackend,
    check_physics,
    list_available_physics,
)
from tests.helpers.playing import StepRecorder

START = np.array(PandaConfig().start_joints, dtype=np.float32)
#: Joint positions with which the robot is in the hand's way in scene 209.
INTO_THE_HAND = np.array([0.285, -0.182, -0.074, -2.037, -0.538, 2.359, 0.688, 0.04, 0.04], dtype=np.float32)
DATA = open_dataset("synthetic", robot="panda_camera")


@pytest.fixture(params=PHYSICS)
def physics(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def episodes() -> Iterator[list[Episode]]:
    """Yield a list of episodes, which are closed at the end."""
    made: list[Episode] = []
    yield made
    for episode in made:
        episode.close()


def load_late_scene(scene_id: int, first: int) -> Scene:
    """Return a scene that begins late in its recording."""
    scene = DATA.load_scene(scene_id)
    assert scene.hand_last == scene.n_frames - 1, "the hand stays"
    motion = {"object_dof": scene.object_dof[first:], "hand_dof": scene.hand_dof[first:]}
    hand_first = max(0, (scene.hand_first or 0) - first)
    return replace(scene, **motion, hand_first=hand_first, hand_last=scene.hand_last - first)


def read_joints(episode: Episode) -> npt.NDArray[np.float32]:
    """Return the joint positions of robot and objects."""
    joints = episode.world.read_joint_snapshot()
    return np.concatenate([joints.robot, joints.objects.ravel()])


@pytest.mark.slow
def test_a_used_world_equals_a_new_one(physics: str, episodes: list[Episode]) -> None:
    """Episodes are bit-equal after any earlier ones, so that results do not depend on the division among workers.

    `yang2021` grasps the object, which is released; the random receiver hits itself, the table and the objects.
    """

    def play(episode: Episode, receiver: str, giver: str, scene: Scene, until: int | None) -> tuple[Any, ...]:
        motion = StepRecorder(read_joints)
        episode.reset(scene)
        players = receivers.make(receiver, DATA), givers.make(giver, DATA)
        run_episode(episode, *players, seed=0, until=until, callbacks=[motion])
        end = episode.status, episode.steps, episode.release_step
        return end, np.array(motion.rows), episode.observe()

    episodes += [Episode(physics), Episode(physics)]
    used, new = episodes
    grasping = "yang2021:wait=0", "replay", load_late_scene(34, 2141), None
    hitting = "random", "noisy", DATA.load_scene(209), 500
    released, expected = play(used, *grasping), play(new, *hitting)
    assert released[0][2] is not None
    end, rows, seen = play(used, *hitting)
    assert end == expected[0]
    np.testing.assert_array_equal(rows, expected[1])
    for key, value in seen.items():
        np.testing.assert_array_equal(value, expected[2][key], err_msg=key)


@pytest.mark.slow
def test_division_of_steps_and_images_change_nothing(physics: str, episodes: list[Episode]) -> None:
    """States are those of long rollouts, whoever looks in between, until the robot touches the hand."""
    scene, camera = load_late_scene(209, 1600), CameraConfig(width=32, height=24)
    found = []
    for size, is_watched in ((100, False), (8, True)):
        episode = Episode(physics)
        episodes.append(episode)
        episode.reset(scene)
        earlier, states = episode.world.read_joint_snapshot(), []
        for target, steps in ((START + np.float32(0.05), 100), (INTO_THE_HAND, 800)):
            left = steps
            while left and not episode.status:
                episode.advance(target, min(size, left), on_step=[lambda one: one.observe()] if is_watched else [])
                left -= min(size, left)
                if is_watched and left % 400 == 0:
                    assert episode.render(camera).std() > 10.0
                    assert episode.world.render_camera(None, True).segmentation.any()
                    episode.world.render_camera(earlier, False)
            objects = episode.world.read_joint_snapshot().objects
            states.append(np.concatenate([episode.world.read_joints_float64(), *objects]))
        assert episode.status == EpisodeStatus.HUMAN_CONTACT
        assert episode.steps == pytest.approx(680, abs=5), "all engines find the contact"
        found.append((episode.steps, states))
    # In fast physics, the time at which bodies near each other wake depends on the division.
    tolerances = (2e-6, 5e-2) if physics == "fast" else (0.0, 0.0)
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
    scene = load_late_scene(209, 300) if data == "synthetic" else OfficialDataset(fake_data).load_scene(14)
    episodes += [Episode("exact"), Episode(name)]
    for episode in episodes:
        episode.reset(scene)
    presence = []
    for steps in (0, 1, 29, 70, 400, 400) if data == "synthetic" else [15] * 30:
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


def throw(physics: str, scene: Scene, targets: list[Action]) -> tuple[EpisodeStatus, int]:
    """Return status and steps after the arm was driven to two joint targets in turn."""
    episode = Episode(physics)
    episode.reset(scene)
    for target, steps in zip(targets, (250, 500), strict=True):
        episode.advance(target, steps)
    episode.close()
    return episode.status, episode.steps


@pytest.mark.slow
@pytest.mark.parametrize(("scene_id", "seed", "touches"), [(53, 19, True), (5, 4, False)])
def test_no_contact_with_the_hand_is_missed(scene_id: int, seed: int, touches: bool) -> None:
    """An arm that moves to random joint positions touches the hand in both engines, at most 3 steps apart."""
    rng, lower, upper = np.random.default_rng(seed), np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
    targets = []
    for _ in range(2):
        target = START.copy()
        target[:7] = lower[:7] + rng.uniform(0.2, 0.8, 7) * (upper - lower)[:7]
        targets.append(target)
    exact, fast = (throw(physics, load_late_scene(scene_id, 2400), targets) for physics in ("exact", "fast"))
    assert bool(exact[0] & EpisodeStatus.HUMAN_CONTACT) == touches
    assert bool(fast[0] & EpisodeStatus.HUMAN_CONTACT) == touches
    assert abs(exact[1] - fast[1]) <= 3


#: The robot starts so near to the hand of scene 209 that it touches the hand after some 15 steps.
NEAR = tuple((START + np.float32(0.97) * (INTO_THE_HAND - START)).tolist())
NEAR_CONFIG = WorldConfig(physics=PhysicsConfig(panda=replace(PandaConfig(), start_joints=NEAR)))
#: The hand appears in the first scene during the episode; the robot touches that of the second one.
BATCH_SCENES = (load_late_scene(14, 390), load_late_scene(209, 2300))
STEPS = (8, 14)
State = dict[str, npt.NDArray[Any]]


def advance_batch(backend: str, rows: list[int], scenes: list[Scene], count: int) -> list[State]:
    """Return the states (r, ...) of some of n episodes after each of `STEPS`; the others are in another scene."""
    episodes = EpisodeBatch(NEAR_CONFIG, count, BatchBackend(backend))
    for row in range(count):
        episodes.reset(row, scenes[rows.index(row)] if row in rows else BATCH_SCENES[0])
    everyone, own = (episodes.arrays.asarray(numbers) for numbers in (np.arange(count), np.array(rows)))
    targets, deviations = np.tile(INTO_THE_HAND, (count, 1)), np.zeros((count, 8), np.float32)
    found = []
    for steps in STEPS:
        running = everyone[episodes.referees.status[everyone] == 0]
        robot, giver = (episodes.arrays.asarray(array)[running] for array in (targets, deviations))
        episodes.advance(running, robot, steps, giver)
        episodes.update_state(everyone)
        state = {**episodes.select_state(own), **episodes.make_infos(own)}
        found.append({key: to_numpy(value) for key, value in state.items()})
    episodes.close()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("backend", [THREADS, WARP])
def test_one_world_of_many_is_that_of_a_single_world(backend: str) -> None:
    """Each of four worlds of a batch equals the only world of another one; those of MuJoCo equal a single episode."""
    if backend == WARP:
        pytest.importorskip("mujoco_warp")
    together = advance_batch(backend, [2, 0], [*BATCH_SCENES], 4)
    alone = [advance_batch(backend, [0], [scene], 1) for scene in BATCH_SCENES]
    assert [found["hand_present"][0].tolist() for found in together] == [[0.0], [1.0]]
    assert together[1]["status"].tolist() == [0, EpisodeStatus.HUMAN_CONTACT]
    for number, found in enumerate(together):
        for key, values in found.items():
            for row, single in enumerate(alone):
                np.testing.assert_array_equal(values[row], single[number][key][0], err_msg=key)
    if backend == THREADS:
        for row, scene in enumerate(BATCH_SCENES):
            episode = Episode("mujoco", NEAR_CONFIG)
            episode.reset(scene)
            for steps, found in zip(STEPS, together, strict=True):
                episode.advance(INTO_THE_HAND, steps)
                for key, value in episode.observe().items():
                    np.testing.assert_array_equal(found[key][row], value, err_msg=key)
            episode.close()
    else:
        expected = advance_batch(THREADS, [2, 0], [*BATCH_SCENES], 4)
        for state, other in zip(together, expected, strict=True):
            for key, value in other.items():
                # Single precision may find the contact some steps earlier.
                atol = 3 if key == "steps" else 0.1 if key in ("robot_joint_velocity", "time") else 1e-3
                np.testing.assert_allclose(state[key], value, rtol=0, atol=atol, err_msg=key)


def test_engines_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    assert PHYSICS == ("exact", "fast", "mujoco")
    with pytest.raises(UnknownNameError, match="valid: exact, fast, mujoco"):
        check_physics("nuclear")
    assert list_available_physics() == PHYSICS
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "pybullet" else find(name, *rest)
    )
    assert list_available_physics() == ("mujoco",)
    with pytest.raises(OptionError, match=r"needs PyBullet.*up to Python 3\.13"):
        Episode("fast")
