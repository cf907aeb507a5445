"""Tests that actions and observations depend neither on future motion nor on the number or name of a scene."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl import givers, receivers
from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Dataset, Scene
from handover_marl.episode import camera_observations
from handover_marl.episode.camera_observations import SensorConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.loop import derive_robot_seed, run_episode
from handover_marl.episode.observations import Observation
from handover_marl.episode.scene_config import SceneConfig
from handover_marl.episode.spaces import OBS_PARTS
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.policies.policy import Giver, Policy, make_policy_context
from handover_marl.policies.populations import POPULATION_FOLDER
from handover_marl.policies.registry import list_available
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.receiver import ReactiveReceiver
from tests.episode.test_camera_observations import GOAL, STEPS
from tests.helpers.equality import assert_equal
from tests.receivers.quick import QUICK_PREPARATION, short_planning  # noqa: F401

SCENE = 209
#: Largest time by which a giver previews the recording (physics steps of 1 ms).
PREVIEW = round(1000 * max(OFFICIAL_CONFIG.giver.preview))
LEARNED = Path(__file__).parents[1] / "data" / "v0_7_0" / "policies" / "receiver.npz"
POPULATION = Path(__file__).with_name("population.json")
RECEIVERS = (
    "hold",
    "random",
    "yang2021:wait=0.1",
    "omg:wait=0.1",
    "omg_hand_aware:wait=0.1",
    "omg_unchecked_last:wait=0.1",
    f"population:population={POPULATION}",
    "reactive",
    "gaddpg:wait=0.1",
    "vision",
    "dagger",
    f"learned:{LEARNED}",
)
Motion = npt.NDArray[np.float32]


def move(motion: Motion, step: int) -> Motion:
    """Return a motion whose positions all move upwards at 1 m/s after a step."""
    changed = motion.copy()
    changed[step + 1 :, ..., 2] += 0.001 * np.arange(1, len(motion) - step).reshape((-1,) + (1,) * (motion.ndim - 2))
    return changed


def cut(motion: Motion, step: int) -> Motion:
    """Return a motion that ends at a step."""
    return motion[: step + 1].copy()


class UndeviatingGiver(Giver):
    """Giver that decides ten times a second and replays the recording at the recorded rate."""

    name = "undeviating"

    def reset(self, seed: int | None = None) -> None:
        pass

    def act(self, observation: Observation) -> np.ndarray:
        return NO_DEVIATION


#: Givers, and the largest rate at which they play a recording, relative to the recorded one.
GIVERS: dict[str | type[Giver], float] = {
    UndeviatingGiver: 1.0,
    "adaptive": 2.0,
    "replay": 1.0,
    "cooperative": 2.0,
    "displaced": 1.0,
    "early_release": 1.0,
    "hesitant": 2.0,
    "hurried": 2.0,
    "interrupting": 1.0,
    f"learned:{POPULATION_FOLDER / 'turning_final.npz'}": 2.0,
    "noisy": 2.0,
    "population": 2.0,
    "recording_spread": 2.0,
    "stop_when_near": 2.0,
    "tired": 1.0,
    "withdrawing": 2.0,
}
CHANGES: tuple[Callable[[Motion, int], Motion], ...] = (move, cut)


@dataclass
class Recorder:
    """Policy that records the observations and actions of another policy.

    Attributes:
        policy: The other policy.
        events: Time (physics steps), observation and action of each decision.
    """

    policy: Policy

    def __post_init__(self) -> None:
        self.name, self.obs_mode = self.policy.name, self.policy.obs_mode
        self.prepare = self.policy.prepare

    @property
    def hold_time(self) -> float:
        return self.policy.hold_time

    def reset(self, seed: int | None = None) -> None:
        self.events: list[tuple[int, Observation, np.ndarray]] = []
        self.policy.reset(seed)

    def act(self, observation: Observation) -> np.ndarray:
        step = round(1000 * float(observation["time"][0]))
        copies = {key: value.copy() for key, value in observation.items()}
        action = self.policy.act(observation)
        self.events.append((step, copies, action.copy()))
        return action


def change_motion(scene: Scene, step: int, change: Callable[[Motion, int], Motion]) -> Scene:
    """Return the scene with changed motion after a step; the hand is absent from 0.5 s after the step on."""
    hand_last = scene.hand_last if scene.hand_last is None else min(scene.hand_last, step + 500)
    return replace(
        scene, object_dof=change(scene.object_dof, step), hand_dof=change(scene.hand_dof, step), hand_last=hand_last
    )


def start_late(scene: Scene) -> Scene:
    """Return the scene from shortly before the hand appears on."""
    first = (scene.hand_first or 0) - 100
    motion = {"object_dof": scene.object_dof[first:], "hand_dof": scene.hand_dof[first:]}
    return replace(scene, **motion, hand_first=100, hand_last=(scene.hand_last or 0) - first)


def make_receiver(reference: str, dataset: Dataset) -> Policy:
    """Return a receiver; `reactive` gets a short validation of its grasps."""
    if reference == "reactive":
        return ReactiveReceiver(make_policy_context(dataset), config=ReactiveConfig(preparation=QUICK_PREPARATION))
    return receivers.make(reference, dataset)


def assert_same_until(end: int, recorded: Recorder, other: list[tuple[int, Observation, np.ndarray]]) -> None:
    """Check that observations and actions until a step are equal."""
    first = [event for event in recorded.events if event[0] <= end]
    second = [event for event in other if event[0] <= end]
    assert_equal(first, second)


def choose_decisions(
    events: list[tuple[int, Observation, np.ndarray]], after: int, rng: np.random.Generator
) -> list[int]:
    """Choose the step of a decision for each change, after the step `after` if there are enough decisions."""
    late = [step for step, *_ in events if step > after]
    steps = late if len(late) >= len(CHANGES) else [step for step, *_ in events]
    chosen: list[int] = rng.choice(steps, len(CHANGES), replace=len(steps) < len(CHANGES)).tolist()
    return chosen


def test_all_policies_of_the_library_are_tested() -> None:
    tested = {reference.partition(":")[0] for reference in RECEIVERS}
    assert tested == set(list_available("receiver"))
    assert {name.split(":")[0] for name in GIVERS if isinstance(name, str)} == set(list_available("giver"))


@pytest.mark.slow
@pytest.mark.parametrize("reference", RECEIVERS, ids=lambda reference: reference.partition(":")[0])
def test_receivers_do_not_know_motion_that_is_still_to_come(reference: str) -> None:
    robot = PANDA_CAMERA if reference.startswith(("gaddpg", "vision")) else PANDA
    dataset = open_dataset("synthetic", robot=robot)
    receiver, scene = Recorder(make_receiver(reference, dataset)), start_late(dataset.load_scene(SCENE))
    episode = Episode("fast", sensors=SensorConfig("rays"))
    rng = np.random.default_rng(0)
    end = 600
    episode.reset(scene)
    run_episode(episode, receiver, until=end)
    events = receiver.events
    # Motion changes less than 40 ms after a decision, so that a preview of 50 ms would contain the change.
    decisions = choose_decisions(events, end // 4, rng)
    for decision, change in zip(decisions, CHANGES, strict=True):
        last = decision + int(rng.integers(0, 40))
        episode.reset(change_motion(scene, last, change))
        run_episode(episode, receiver, until=last + 1)
        assert_same_until(last, receiver, events)
    episode.close()


@pytest.mark.slow
@pytest.mark.parametrize("policy", GIVERS)
def test_givers_see_no_further_ahead_than_their_preview(policy: str | type[Giver]) -> None:
    dataset = open_dataset("synthetic")
    giver, receiver = Recorder(givers.make(policy, dataset)), receivers.make("yang2021:wait=0.1", dataset)
    scene = start_late(dataset.load_scene(SCENE))
    episode = Episode("fast")
    rng = np.random.default_rng(0)
    episode.reset(scene)
    run_episode(episode, receiver, giver, until=500)
    events = giver.events
    decisions = choose_decisions(events, 200, rng)
    for decision, change in zip(decisions, CHANGES, strict=True):
        later = int(rng.integers(0, 40))
        frame = round(GIVERS[policy] * decision) + PREVIEW + later
        episode.reset(change_motion(scene, frame, change))
        run_episode(episode, receiver, giver, until=decision + later + 1)
        assert_same_until(decision, giver, events)
    episode.close()


DATA = open_dataset("synthetic", robot=PANDA_CAMERA)
NOISY_START = WorldConfig(initial_joint_noise=0.02)
#: More than 1,024 pixels show the object after `STEPS` steps towards `GOAL`.
NUMBERED = DATA.load_scene(9)
#: Receivers that use random numbers or images.
CASES = [reference for reference in RECEIVERS if reference.startswith(("random", "population", "gaddpg", "vision"))]


def rename(scene: Scene, scene_id: int) -> Scene:
    """Return a copy of the scene with another number, name and subject."""
    return replace(scene, info=replace(scene.info, scene_id=scene_id, name=f"x/{scene_id}"))


def start(episode: Episode, scene: Scene, receiver: Policy, end: int) -> None:
    """Let a receiver act in a scene after the robot has moved towards the object."""
    episode.reset(scene, derive_robot_seed(3, scene))
    episode.advance(GOAL, STEPS)
    run_episode(episode, receiver, seed=3, until=STEPS + end)


@pytest.mark.slow
@pytest.mark.parametrize("reference", CASES, ids=lambda value: value.partition(":")[0])
def test_receivers_do_not_depend_on_the_scene_number(monkeypatch: pytest.MonkeyPatch, reference: str) -> None:
    # Few points, so that all clouds are subsampled.
    monkeypatch.setattr(camera_observations, "N_POINTS", 512)
    receiver = Recorder(make_receiver(reference, DATA))
    episode = Episode("fast", NOISY_START, sensors=SensorConfig("rays"))
    start(episode, NUMBERED, receiver, 300)
    events = receiver.events
    start(episode, rename(NUMBERED, 777), receiver, 300)
    assert events
    assert_same_until(STEPS + 300, receiver, events)
    episode.close()


@pytest.mark.slow
@pytest.mark.parametrize(("renderer", "noise"), [("bullet", "realsense"), ("rays", None), ("rays", "imperfect")])
def test_observations_do_not_depend_on_the_scene_number(renderer: str, noise: str | None) -> None:
    config = WorldConfig() if noise is None else NOISY_START
    sensors = SceneConfig(renderer=renderer, camera_noise=noise).sensors
    episode, seen = Episode("fast", config, sensors=sensors), []
    for scene in (NUMBERED, rename(NUMBERED, 777)):
        start(episode, scene, make_receiver("hold", DATA), 1)
        seen.append([{**episode.observe(), **episode.observe_camera(obs_mode)} for obs_mode in OBS_PARTS])
    assert_equal(*seen)
    episode.close()
