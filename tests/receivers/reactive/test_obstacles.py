"""Tests of keeping clear of the other objects on the table."""

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.observations import Observation
from handover_marl.geometry.poses import transform_points
from handover_marl.planning.clearance import compute_grasp_clearances
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.reactive.config import ReactiveConfig
from handover_marl.receivers.reactive.grasp_contact import load_obstacle
from handover_marl.receivers.reactive.receiver import ReactiveReceiver
from handover_marl.receivers.reactive.scene_estimate import PoseSceneEstimate
from tests.receivers.quick import QUICK_PREPARATION, observe_handover

DATA = SyntheticDataset()
CONTEXT = make_policy_context(DATA)
CONFIG = ReactiveConfig(preparation=QUICK_PREPARATION)
SCENE, TIMES = 5, np.arange(2.0, 2.6, 0.05)
FAR_AWAY = np.array([5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 1.0], dtype=np.float32)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture(scope="module")
def handover_observation() -> Observation:
    """Return the observation while the object is held out."""
    return observe_handover(DATA.load_scene(SCENE), 2900)


def make_receiver() -> ReactiveReceiver:
    receiver = ReactiveReceiver(CONTEXT, config=CONFIG)
    receiver.reset()
    return receiver


def make_estimate(observation: Observation) -> PoseSceneEstimate:
    estimate = PoseSceneEstimate(make_receiver().arm, CONFIG, lambda name: load_obstacle(CONTEXT, name, CONFIG))
    estimate.update(observation)
    return estimate


def move_others(observation: Observation, poses: np.ndarray) -> Observation:
    """Return an observation with other poses (7,) or (4, 7) of the objects besides the first one."""
    moved = observation["object_poses"].copy()
    moved[1:] = poses
    return {**observation, "object_poses": moved}


def remove_others(observation: Observation) -> Observation:
    mask = np.array([1.0, 0.0, 0.0, 0.0, 0.0], dtype=np.float32)
    return {**observation, "object_mask": mask}


def act(receiver: ReactiveReceiver, observation: Observation) -> np.ndarray:
    """Return the actions for an observation that stays the same for some time."""
    times = (np.array([time], dtype=np.float32) for time in TIMES)
    return np.array([receiver.act({**observation, "time": time}) for time in times])


@pytest.mark.slow
def test_objects_that_are_absent_or_out_of_reach_change_nothing(handover_observation: Observation) -> None:
    alone = remove_others(handover_observation)
    beyond = move_others(handover_observation, FAR_AWAY)
    assert make_estimate(alone).obstacles is None
    assert make_estimate(beyond).obstacles is None
    np.testing.assert_array_equal(act(make_receiver(), alone), act(make_receiver(), beyond))


def test_grasps_beside_other_objects_are_preferred(handover_observation: Observation) -> None:
    free = make_receiver()
    act(free, remove_others(handover_observation))
    assert free.selector.chosen is not None
    pose = handover_observation["object_poses"][0].astype(np.float64)
    # The other objects stand where the hand of the gripper would be.
    blocked = free.selector.compute_grasp_pose(free.selector.chosen, pose)
    blocked[:3] = transform_points(blocked, np.array([0.0, 0.0, -0.1]))
    observation = move_others(handover_observation, blocked)
    obstacles = make_estimate(observation).obstacles
    assert obstacles is not None
    receiver = make_receiver()
    act(receiver, observation)
    assert receiver.selector.chosen is not None
    chosen = receiver.selector.compute_grasp_pose(receiver.selector.chosen, pose)
    assert compute_grasp_clearances(blocked[None], obstacles)[0] < 0.0
    assert compute_grasp_clearances(chosen[None], obstacles, CONFIG.approach.standoff)[0] > 0.0


@pytest.mark.slow
def test_no_other_object_is_touched() -> None:
    """The receiver succeeds in a scene without touching the other objects.

    If it ignored the wood block, the robot's wrist would be stuck on it until the episode times out.
    """
    touches = []
    episode, receiver = Episode("fast"), make_receiver()
    episode.reset(DATA.load_scene(69))

    class Recorder(EpisodeCallback):
        def on_step(self, episode: Episode) -> None:
            touches.append(episode.contacts.robot_touches_others)

    run_episode(episode, receiver, seed=0, callbacks=[Recorder()])
    assert episode.status.label == "success"
    assert not any(touches)
    episode.close()
