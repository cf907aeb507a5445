"""Tests of exact physics, which equals recordings of the reference simulator bit for bit."""

import json
from pathlib import Path

import numpy as np
import pytest

from handover_marl import receivers
from handover_marl.datasets import OfficialDataset
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from tests.conftest import RECORDINGS
from tests.playing import play

pytestmark = pytest.mark.slow

STRIDE = 10
NAMES = sorted(path.stem for path in Path(RECORDINGS).glob("scene*.npz")) if RECORDINGS else ["none"]
if RECORDINGS and not NAMES:
    raise FileNotFoundError(f"no recordings (scene*.npz) in {RECORDINGS}")
SEVERAL = sorted(path.stem for path in Path(RECORDINGS).glob("multi/*.npz")) if RECORDINGS else ["none"]
YANG = [name for name in NAMES if name.endswith("yang")] or ["none"]


def read_recording(recordings: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(recordings / f"{name}.npz") as archive:
        return dict(archive)


def assert_same_state(episode: Episode, expected: dict[str, np.ndarray], row: int) -> None:
    seen = episode.observe()
    n_objects = int(seen["object_mask"].sum())
    pairs = {
        "robot_joint_position": seen["robot_joint_position"],
        "robot_joint_velocity": seen["robot_joint_velocity"],
        "object_dof_position": episode.world.read_object_joints(),
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


@pytest.mark.parametrize("name", YANG)
def test_yang_receiver_gives_the_recording(name: str, recordings: Path, real_dataset: OfficialDataset) -> None:
    expected = read_recording(recordings, name)
    episode, states = Episode("exact"), StateComparison(expected)
    policy = receivers.make("yang2021", real_dataset)
    scene = real_dataset.load_scene(int(expected["scene_id"]))
    actions, times = play(episode, scene, policy, None, states)
    np.testing.assert_array_equal(actions, expected["action"])
    assert times.shape == (len(actions),)
    assert states.compared == -(-len(actions) // STRIDE)
    assert_same_end(episode, expected)
    episode.close()


# Two of the scenes without a recording are played; experiments/make_results.py evaluates all test splits.
def test_yang_receiver_on_s0_val(recordings: Path, real_dataset: OfficialDataset) -> None:
    expected = json.loads((recordings / "yang_s0_val.json").read_text())
    scene_ids = real_dataset.list_scenes("s0", "val")
    assert sorted(expected) == sorted(map(str, scene_ids))
    episode = Episode("exact")
    policy = receivers.make("yang2021", real_dataset)
    recorded = {int(read_recording(recordings, name)["scene_id"]) for name in YANG}
    outcomes = {}
    for scene_id in [number for number in scene_ids if number not in recorded][::15]:
        play(episode, real_dataset.load_scene(scene_id), policy)
        outcomes[str(scene_id)] = (int(episode.status), episode.steps, episode.release_step or -1)
    wanted = {key: (row["status"], row["steps"], row["release"]) for key, row in expected.items()}
    assert outcomes == {key: wanted[key] for key in outcomes}
    episode.close()
