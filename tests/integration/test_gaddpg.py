"""Tests of GA-DDPG's protocol: it equals recordings of the original scripts bit for bit."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.datasets import OfficialDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import ActionRecorder, EpisodeCallback, run_episode
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import Action, make_policy_context
from handover_marl.receivers.gaddpg import GaddpgReceiver
from tests.conftest import RECORDINGS
from tests.integration.test_reference import STRIDE

pytestmark = pytest.mark.slow

NAMES = sorted(path.stem for path in Path(RECORDINGS).glob("gaddpg/*.npz")) if RECORDINGS else ["none"]
#: Steps of an episode that are compared, with some decisions after the wait (s); one with all decisions, but not the
#: long motions after them. One episode is played to its end.
MAX_STEPS, ALL_DECISIONS, WHOLE = {0.0: 1000, 3.0: 3500}, "gaddpg_scene637_wo_hold", "gaddpg_scene105_hold"
#: Recording that was made after another one in the same process, in another world. The scripts query PyBullet's first
#: client for inverse kinematics. That was the client of the first world, so every query started from the robot's last
#: joints in that world.
ELSEWHERE = "gaddpg_scene009_wo_hold"
JOINTS_ELSEWHERE = np.array(
    [
        *(0.42330452691542547, -0.53558860035163, -0.5067236429772248, -2.833738975883339, 1.2077669323134543),
        *(2.285642686694384, -0.32287658589311385, 0.0009643714855820239, 0.0008184576660529681),
    ]
)


class StandIn:
    """Network function of the recordings, which records its inputs and returns the recorded outputs.

    It checks that the recorded outputs are those of the function's formula.
    """

    def __init__(self, expected: dict[str, npt.NDArray[np.generic]]) -> None:
        self.inputs: list[npt.NDArray[np.float64]] = []
        self.remaining: list[int] = []
        self._outputs = expected["network_output"]

    def __call__(self, points: npt.NDArray[np.float64], remaining: int) -> npt.NDArray[np.float64]:
        self.inputs.append(points.copy())
        self.remaining.append(remaining)
        mean = points[:3, 6:].mean(axis=1)
        shift = np.clip(0.3 * (mean - np.array([0.0, 0.0, 0.085])), -0.06, 0.06)
        turn = [0.06 * np.sin(9.0 * mean[1]), 0.06 * np.sin(7.0 * mean[0]), 0.01 * np.cos(remaining)]
        answer = np.array(self._outputs[len(self.inputs) - 1])
        np.testing.assert_array_equal(answer[:3], shift)
        # Sines of NumPy 1.23.5, which made the recordings, differ from others by up to four units in the last place.
        np.testing.assert_array_max_ulp(answer[3:], np.array(turn), maxulp=4)
        return answer


class Watched(GaddpgReceiver):
    """GA-DDPG receiver that records the steps of its decisions.

    Attributes:
        joints: Joint positions from which inverse kinematics start instead of the observed ones, or None.
    """

    joints: npt.NDArray[np.float64] | None = None

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.decision_steps: list[int] = []

    def act(self, observation: Observation) -> Action:
        before = len(self._network.inputs)  # type: ignore[attr-defined]
        if self.joints is not None:
            observation = {**observation, "robot_joint_position_exact": self.joints}
        action = super().act(observation)
        if len(self._network.inputs) > before:  # type: ignore[attr-defined]
            self.decision_steps.append(round(1000.0 * float(observation["time"][0])))
        return action


class Joints(EpisodeCallback):
    """Callback that records the robot's joints after the steps 1, 11, 21, ..."""

    def __init__(self) -> None:
        self.rows: list[npt.NDArray[np.float32]] = []

    def on_step(self, episode: Episode) -> None:
        if episode.steps % STRIDE == 1:
            self.rows.append(episode.world.read_joint_snapshot().robot)


@pytest.mark.parametrize("name", NAMES)
def test_decisions_actions_and_outcome_are_the_recorded_ones(name: str, recordings: Path, real_data: Path) -> None:
    dataset = OfficialDataset(real_data, robot="panda_camera")
    with np.load(recordings / f"gaddpg/{name}.npz") as archive:
        expected = dict(archive)
    end = {WHOLE: int(expected["steps"]), ALL_DECISIONS: 3200}.get(name, MAX_STEPS[float(expected["wait"])])
    network, joints, log = StandIn(expected), Joints(), ActionRecorder()
    receiver = Watched(make_policy_context(dataset), network=network, wait=float(expected["wait"]))
    receiver.joints = JOINTS_ELSEWHERE if name == ELSEWHERE else None
    episode = Episode("exact")
    episode.reset(dataset.load_scene(int(expected["scene_id"])))
    run_episode(episode, receiver, until=end, callbacks=[joints, log])
    assert len(network.inputs) > 3
    for points, wanted in zip(network.inputs, expected["network_input"], strict=False):
        np.testing.assert_array_equal(points, wanted)
    means, count = [points[:3, 6:].mean(axis=1) for points in network.inputs], len(network.inputs)
    np.testing.assert_array_equal(means, expected["input_mean"][:count])
    assert network.remaining == expected["remaining"][:count].tolist()
    assert receiver.decision_steps == [step for step in expected["decision_steps"].tolist() if step < end]
    np.testing.assert_array_equal(log.actions, expected["action"][:end])
    np.testing.assert_array_equal(joints.rows, expected["robot_joint_position"][: len(joints.rows)])
    if name == WHOLE:
        assert (episode.steps, episode.status) == (expected["steps"], expected["status"])
    episode.close()
