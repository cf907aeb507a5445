"""Tests of exact physics, which equals recordings of the reference simulator bit for bit."""

import json
from pathlib import Path

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.datasets import OfficialDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import ActionRecorder, EpisodeCallback, run_episode
from handover_marl.receivers.omg import OmgReceiver
from tests.conftest import RECORDINGS
from tests.helpers.playing import play

pytestmark = pytest.mark.slow

STRIDE = 10
#: Steps after which recordings of one object are cut: after the first motion of the hand or, in some, after the first
#: decisions of the receiver. The successful handovers are played to their ends; what happens later is in them, too.
MAX_STEPS, WITH_DECISIONS = 1500, {"scene009_yang": 3300, "scene105_demo": 3300}
WHOLE = ("scene012_yang", "scene099_yang", "scene344_yang")
NAMES = sorted(path.stem for path in Path(RECORDINGS).glob("scene*.npz")) if RECORDINGS else ["none"]
if RECORDINGS and not NAMES:
    raise FileNotFoundError(f"no recordings (scene*.npz) in {RECORDINGS}")
SEVERAL = sorted(path.stem for path in Path(RECORDINGS).glob("multi/*.npz")) if RECORDINGS else ["none"]
YANG = [name for name in NAMES if name.endswith("yang")] or ["none"]
#: Recordings with the receiver that are played.
PLAYED = [name for name in YANG if name[5:8] not in ("034", "109", "159")]


def read_recording(recordings: Path, name: str) -> dict[str, np.ndarray]:
    """Read a recording, and cut its actions."""
    with np.load(recordings / f"{name}.npz") as archive:
        content = dict(archive)
    if name in NAMES and name not in WHOLE:
        content["action"] = content["action"][: WITH_DECISIONS.get(name, MAX_STEPS)]
    return content


def assert_same_state(episode: Episode, expected: dict[str, np.ndarray], row: int) -> None:
    seen = episode.observe()
    n_objects = int(seen["object_mask"].sum())
    pairs = {
        "robot_joint_position": seen["robot_joint_position"],
        "robot_joint_velocity": seen["robot_joint_velocity"],
        "object_dof_position": episode.world.read_joint_snapshot().objects,
        "object_pose": seen["object_poses"][:n_objects],
        "hand_dof_position": seen["hand_dof_position"],
        "hand_link_pose": seen["gripper_pose"],
    }
    # Recordings of several objects have no pose of the Panda's hand link; those of one object have no object axis.
    for key in pairs.keys() & expected.keys():
        value, wanted = pairs[key], expected[key][row]
        assert value.dtype == np.float32
        np.testing.assert_array_equal(value, wanted.reshape(value.shape), err_msg=f"{key} after step {episode.steps}")


# The other recordings are played by the receiver that made them in `test_yang_receiver_gives_the_recording`.
@pytest.mark.parametrize("name", [name for name in NAMES if name not in YANG] or ["none"])
def test_replayed_actions_give_the_recorded_states(name: str, recordings: Path, real_dataset: OfficialDataset) -> None:
    assert_replays(read_recording(recordings, name), real_dataset)


@pytest.mark.parametrize("name", SEVERAL)
def test_several_objects_too(name: str, recordings: Path, several_objects: OfficialDataset) -> None:
    assert_replays(read_recording(recordings, f"multi/{name}"), several_objects)


def assert_replays(expected: dict[str, np.ndarray], dataset: OfficialDataset) -> None:
    """Play the recorded actions and compare every tenth state and the outcome."""
    episode = Episode("exact")
    episode.reset(dataset.load_scene(int(expected["scene_id"])))
    for step, action in enumerate(expected["action"]):
        assert not episode.status, f"ended early, after {episode.steps} steps"
        episode.advance(action, 1)
        if step % STRIDE == 0:
            assert_same_state(episode, expected, step // STRIDE)
    assert_same_end(episode, expected)
    episode.close()


def assert_same_end(episode: Episode, expected: dict[str, np.ndarray]) -> None:
    if len(expected["action"]) < expected["steps"]:
        assert not episode.status
        return
    assert episode.steps == expected["steps"]
    assert episode.status == expected["status"]
    assert (episode.release_step or -1) == expected["release_step"]


class StateComparison(EpisodeCallback):
    """Callback that compares every tenth state with a recording."""

    def __init__(self, expected: dict[str, np.ndarray]) -> None:
        self.expected, self.compared = expected, 0

    def on_step(self, episode: Episode) -> None:
        if episode.steps % STRIDE == 1:
            assert_same_state(episode, self.expected, episode.steps // STRIDE)
            self.compared += 1


@pytest.mark.parametrize("name", PLAYED)
def test_yang_receiver_gives_the_recording(name: str, recordings: Path, real_dataset: OfficialDataset) -> None:
    expected = read_recording(recordings, name)
    episode, states, log = Episode("exact"), StateComparison(expected), ActionRecorder()
    episode.reset(real_dataset.load_scene(int(expected["scene_id"])))
    receiver = receivers.make("yang2021", real_dataset)
    run_episode(episode, receiver, until=len(expected["action"]), callbacks=[states, log])
    np.testing.assert_array_equal(log.actions, expected["action"])
    assert log.times.shape == (len(log.actions),)
    assert states.compared == -(-len(log.actions) // STRIDE)
    assert_same_end(episode, expected)
    episode.close()


# One of the scenes without a recording is played, which ends with a drop; experiments/make_results.py evaluates all
# test splits.
def test_yang_receiver_on_s0_val(recordings: Path, real_dataset: OfficialDataset) -> None:
    expected = json.loads((recordings / "yang_s0_val.json").read_text())
    scene_ids = real_dataset.list_scenes("s0", "val")
    assert sorted(expected) == sorted(map(str, scene_ids))
    episode = Episode("exact")
    policy = receivers.make("yang2021", real_dataset)
    play(episode, real_dataset.load_scene(194), policy)
    wanted = expected["194"]
    found = episode.status, episode.steps, episode.release_step or -1
    assert found == (wanted["status"], wanted["steps"], wanted["release"])
    episode.close()


def test_goal_set_holds_the_goal_of_the_original(real_dataset: OfficialDataset, recordings: Path) -> None:
    """One of the planner's goals has the approach of the plan in HandoverSim's demonstration of scene 105."""
    receiver = receivers.make("omg", real_dataset)
    assert isinstance(receiver, OmgReceiver)
    episode = Episode("fast")
    episode.reset(real_dataset.load_scene(105))
    receiver.reset()
    episode.advance(receiver.act(episode.observe()), 3000)
    receiver.act(episode.observe())
    episode.close()
    assert receiver.plan is not None
    with np.load(recordings / "scene105_demo.npz") as recorded:
        actions = recorded["action"]
    changes = np.flatnonzero(np.abs(np.diff(actions, axis=0)).max(axis=1) > 1e-7) + 1
    # The plan has 30 waypoints, the approach the last five of them.
    approach = actions[changes[25:30], :7]
    assert np.abs(receiver.plan.goals.approaches - approach).max(axis=(1, 2)).min() < 1e-4
