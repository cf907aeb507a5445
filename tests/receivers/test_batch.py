"""Tests of batched receivers: in recorded rollouts, their actions equal those of single receivers to the bit."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo")

from handover_marl import givers
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.observations import Observation
from handover_marl.policies.policy import make_policy_context
from handover_marl.receivers.yang2021 import Yang2021Batch, Yang2021Receiver

DATA = SyntheticDataset()
CONTEXT = make_policy_context(DATA)
#: Scenes with objects of different shapes, and their givers; two rollouts for each row of the batch.
ROLLOUTS = ((14, "replay"), (64, "cooperative"), (209, "noisy"), (9, "withdrawing"))
ROWS = 2

Rollout = list[tuple[int, Observation, np.ndarray]]


class RecordingReceiver(Yang2021Receiver):
    """Receiver that records the physics step, the observation and the action of each decision."""

    def reset(self, seed: int | None = None) -> None:
        super().reset(seed)
        self.decisions: Rollout = []

    def act(self, observation: Observation) -> np.ndarray:
        action = super().act(observation)
        copied = {key: value.copy() for key, value in observation.items()}
        self.decisions.append((round(1000.0 * float(observation["time"][0])), copied, action))
        return action


def record_rollouts() -> list[Rollout]:
    """Play all rollouts with one receiver, whose state must not carry over between them; return the decisions."""
    episode, receiver, found = Episode("mujoco"), RecordingReceiver(CONTEXT, wait=0.4), []
    for number, (scene_id, giver) in enumerate(ROLLOUTS):
        episode.reset(DATA.load_scene(scene_id))
        run_episode(episode, receiver, givers.make(giver, DATA), seed=number)
        found.append(receiver.decisions)
    episode.close()
    return found


@pytest.mark.slow
def test_a_batch_acts_as_single_receivers() -> None:
    """The actions of a batch equal those of single receivers to the bit.

    Rows start and restart at different times, so that they are in different phases at the same time.
    """
    rollouts = record_rollouts()
    assert any(not action[7:].any() for decisions in rollouts for *_, action in decisions), "fingers have closed"
    batch = Yang2021Batch(Yang2021Receiver(CONTEXT, wait=0.4), ROWS)
    # Per row: rollouts that have not ended, start time (ms) of the current one, and number of its next decision.
    waiting = [[first, second] for first, second in zip(rollouts[:ROWS], rollouts[ROWS:], strict=True)]
    starts, numbers = [0, 130], [0] * ROWS
    for row in range(ROWS):
        batch.reset(row, None, ("025_mug",))
    for now in range(60_000):
        due = []
        for row in range(ROWS):
            if waiting[row] and numbers[row] == len(waiting[row][0]):
                waiting[row].pop(0)
                starts[row], numbers[row] = now + 7, 0
                batch.reset(row, None, ("025_mug",))
            if waiting[row] and now - starts[row] == waiting[row][0][numbers[row]][0]:
                due.append(row)
        if not any(waiting):
            return
        if due:
            running = np.array([row for row in range(ROWS) if waiting[row] and now >= starts[row]])

            def observe(rows: np.ndarray, expected: list[int] = due) -> Observation:
                assert rows.tolist() == expected, "decisions are due at the steps of the recording"
                seen = [waiting[row][0][numbers[row]][1] for row in expected]
                return {key: np.stack([one[key] for one in seen]) for key in seen[0]}

            actions, _ = batch.act(running, observe, np.array([now - starts[row] for row in running]))
            for row, action in zip(running.tolist(), actions, strict=True):
                number = numbers[row] if row in due else numbers[row] - 1
                np.testing.assert_array_equal(action, waiting[row][0][number][2])
            for row in due:
                numbers[row] += 1
    pytest.fail("rollouts have not ended")


def test_an_object_without_grasps() -> None:
    """The robot of a row whose object has no grasps stays where it is, and those of the other rows move."""
    episode, scene = Episode("mujoco"), DATA.load_scene(14)
    episode.reset(scene)
    state = episode.observe()
    episode.close()
    missing = DATA.object_names[int(state["object_classes"][0]) + 1]
    context = replace(CONTEXT, grasps=lambda name: None if name == missing else DATA.load_grasps(name))
    batch = Yang2021Batch(Yang2021Receiver(context, wait=0.0), 3)
    found = {key: np.stack([values] * 3) for key, values in state.items()}
    found["object_classes"][1, 0] += 1
    for row in range(3):
        batch.reset(row, None, scene.info.object_names)
    actions, _ = batch.act(
        np.arange(3), lambda rows: {key: values[rows] for key, values in found.items()}, np.zeros(3, int)
    )
    np.testing.assert_array_equal(actions[1, :7], state["robot_joint_position"][:7])
    np.testing.assert_array_equal(actions[0], actions[2])
    assert np.abs(actions[0, :7] - state["robot_joint_position"][:7]).max() > 0.1
