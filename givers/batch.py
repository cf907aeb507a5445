"""Scripted givers that act in many episodes at once, on arrays with the episode as first axis.

Actions equal those of single givers to 1e-6 after the rounding to float32, and do not depend on the
batch.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import Observation
from handover_marl.geometry.poses import compute_lengths
from handover_marl.givers.cooperative import CooperativeGiver
from handover_marl.givers.cooperative_batch import CooperativeBatch, compute_grip_distances, make_giver_actions
from handover_marl.givers.noisy import NoisyGiver
from handover_marl.givers.replay import ReplayGiver
from handover_marl.givers.timing import HesitantGiver, HurriedGiver, StopWhenNearGiver
from handover_marl.givers.withdrawing import WithdrawingGiver
from handover_marl.policies.batch import ArrayPolicy, PolicyBatch
from handover_marl.policies.policy import Policy

Actions = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]

_PAUSE = -1.0  # playback rate minus 1


class ReplayBatch(ArrayPolicy[ReplayGiver]):
    """Batch of `ReplayGiver`."""

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8) that follow the recordings."""
        return make_giver_actions(len(rows))


class HurriedBatch(ArrayPolicy[HurriedGiver]):
    """Batch of `HurriedGiver`."""

    def __init__(self, policy: HurriedGiver, count: int) -> None:
        super().__init__(policy, count)
        self._rate = np.zeros(count)

    def start(self, row: int, seed: int | None) -> None:
        """Draw the playback speed of an episode."""
        config = self._policy.config
        self._rate[row] = np.random.default_rng(seed).uniform(config.min_rate, config.max_rate)

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8) that replay at the speeds drawn for these episodes."""
        return make_giver_actions(len(rows), rate=self._rate[rows])


class StopWhenNearBatch(ArrayPolicy[StopWhenNearGiver]):
    """Batch of `StopWhenNearGiver`."""

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause near the gripper."""
        is_near = compute_grip_distances(observation) < self._policy.config.distance
        return make_giver_actions(len(rows), rate=np.where(is_near, _PAUSE, 0.0))


class HesitantBatch(ArrayPolicy[HesitantGiver]):
    """Batch of `HesitantGiver`, whose random numbers are drawn episode by episode."""

    def __init__(self, policy: HesitantGiver, count: int) -> None:
        super().__init__(policy, count)
        self._until = np.zeros(count)
        self._rngs = [np.random.default_rng(0)] * count

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without a pause."""
        self._rngs[row], self._until[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause, or replay at the recorded speed."""
        giver, config = self._policy, self._policy.config
        now = observation["time"][:, 0].astype(np.float64)
        for row, time in zip(rows.tolist(), now.tolist(), strict=True):
            rng = self._rngs[row]
            if time >= self._until[row] and rng.random() < config.pauses_per_second * giver.control_period:
                self._until[row] = time + rng.uniform(config.shortest_pause, config.longest_pause)
        return make_giver_actions(len(rows), rate=np.where(now < self._until[rows], _PAUSE, 0.0))


class NoisyBatch(ArrayPolicy[NoisyGiver]):
    """Batch of `NoisyGiver`, whose random numbers are drawn episode by episode."""

    def __init__(self, policy: NoisyGiver, count: int) -> None:
        super().__init__(policy, count)
        self._rngs, self._deviation = [np.random.default_rng(0)] * count, np.zeros((count, 7))
        config = policy.config
        self._scale = np.array([config.rate, *[config.displacement] * 3, *[config.rotation] * 3])
        self._decay = np.exp(-policy.control_period / config.time_constant)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation."""
        self._rngs[row], self._deviation[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the next random deviations."""
        noise = np.array([self._rngs[row].standard_normal(7) for row in rows.tolist()])
        self._deviation[rows] = (
            self._decay * self._deviation[rows] + np.sqrt(1.0 - self._decay**2) * self._scale * noise
        )
        deviation = self._deviation[rows]
        return make_giver_actions(len(rows), deviation[:, 0], deviation[:, 1:4], deviation[:, 4:])


class WithdrawingBatch(ArrayPolicy[WithdrawingGiver]):
    """Batch of `WithdrawingGiver`."""

    def __init__(self, policy: WithdrawingGiver, count: int) -> None:
        super().__init__(policy, count)
        self._last_distance, self._until = np.full(count, np.nan), np.full(count, -1.0)
        self._displacement = np.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation."""
        self._last_distance[row], self._until[row], self._displacement[row] = np.nan, -1.0, 0.0

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8) that withdraw the hands, or follow the recordings."""
        giver, config = self._policy, self._policy.config
        now = observation["time"][:, 0].astype(np.float64)
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        distance = compute_lengths(away).astype(np.float64)
        speed = (self._last_distance[rows] - distance) / giver.control_period
        self._last_distance[rows] = distance
        # Before the second decision the speed is nan, which is not above the limit.
        is_present = observation["hand_present"][:, 0] != 0.0
        flees = is_present & (distance < config.max_distance) & (speed > config.max_speed)
        self._until[rows[flees]] = now[flees] + config.return_after
        withdrawal = config.withdrawal * away / np.maximum(compute_lengths(away), 1e-6)[:, None]
        self._displacement[rows[flees]] = withdrawal[flees]
        is_away = now < self._until[rows]
        return make_giver_actions(len(rows), displacement=np.where(is_away[:, None], self._displacement[rows], 0.0))


_BATCHES: dict[type[Policy], Callable[[Any, int], PolicyBatch]] = {
    ReplayGiver: ReplayBatch,
    HurriedGiver: HurriedBatch,
    StopWhenNearGiver: StopWhenNearBatch,
    HesitantGiver: HesitantBatch,
    NoisyGiver: NoisyBatch,
    WithdrawingGiver: WithdrawingBatch,
    CooperativeGiver: CooperativeBatch,
}


def make_giver_batch(policy: Policy, count: int) -> PolicyBatch | None:
    """Return the batch of a scripted giver, or None for a giver that has none.

    Args:
        policy: Giver of a single episode. A subclass of a scripted giver has no batch.
        count: Number of episodes.
    """
    batch = _BATCHES.get(type(policy))
    return None if batch is None else batch(policy, count)
