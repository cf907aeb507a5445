"""Scripted givers that act in many episodes at once, on arrays with the episode as first axis.

Actions equal those of single givers to 1e-6 after the rounding to float32, and do not depend on the
batch.
"""

import math
from collections.abc import Callable

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyIndices, ArrayFactory, to_numpy, widen
from handover_marl.geometry.poses import compute_lengths
from handover_marl.givers.cooperative import CooperativeGiver
from handover_marl.givers.cooperative_batch import CooperativeBatch, compute_gripper_object_distances
from handover_marl.givers.noisy import NoisyGiver
from handover_marl.givers.replay import ReplayGiver
from handover_marl.givers.timing import HesitantGiver, HurriedGiver, StopWhenNearGiver
from handover_marl.givers.withdrawing import WithdrawingGiver
from handover_marl.policies.batch import (
    Actions,
    ArrayPolicy,
    PolicyBatch,
    make_giver_actions,
)
from handover_marl.policies.policy import Policy

_PAUSE = -1.0  # playback rate minus 1


class ReplayBatch(ArrayPolicy[ReplayGiver]):
    """Batch of `ReplayGiver`."""

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that follow the recordings."""
        return make_giver_actions(len(rows), arrays=self._arrays)


class HurriedBatch(ArrayPolicy[HurriedGiver]):
    """Batch of `HurriedGiver`."""

    def __init__(self, policy: HurriedGiver, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        super().__init__(policy, count, arrays=arrays)
        self._rate = arrays.zeros(count)

    def start(self, row: int, seed: int | None) -> None:
        """Draw the playback speed of an episode."""
        config = self._policy.config
        self._rate[row] = np.random.default_rng(seed).uniform(config.min_rate, config.max_rate)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that replay at the speeds drawn for these episodes."""
        return make_giver_actions(len(rows), rate=self._rate[rows], arrays=self._arrays)


class StopWhenNearBatch(ArrayPolicy[StopWhenNearGiver]):
    """Batch of `StopWhenNearGiver`."""

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause near the gripper."""
        is_near = compute_gripper_object_distances(observation) < self._policy.config.distance
        return make_giver_actions(len(rows), rate=self._arrays.xp.where(is_near, _PAUSE, 0.0), arrays=self._arrays)


class HesitantBatch(ArrayPolicy[HesitantGiver]):
    """Batch of `HesitantGiver`, whose random numbers are drawn episode by episode."""

    def __init__(self, policy: HesitantGiver, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        super().__init__(policy, count, arrays=arrays)
        # On the host, like the random numbers.
        self._until = np.zeros(count)
        self._rngs = [np.random.default_rng(0)] * count

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without a pause."""
        self._rngs[row], self._until[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause, or replay at the recorded speed."""
        giver, config = self._policy, self._policy.config
        now, numbers = to_numpy(observation["time"][:, 0]).astype(np.float64), to_numpy(rows)
        for row, time in zip(numbers.tolist(), now.tolist(), strict=True):
            rng = self._rngs[row]
            if time >= self._until[row] and rng.random() < config.pauses_per_second * giver.control_period:
                self._until[row] = time + rng.uniform(config.shortest_pause, config.longest_pause)
        rate = self._arrays.asarray(np.where(now < self._until[numbers], _PAUSE, 0.0))
        return make_giver_actions(len(rows), rate=rate, arrays=self._arrays)


class NoisyBatch(ArrayPolicy[NoisyGiver]):
    """Batch of `NoisyGiver`, whose random numbers are drawn episode by episode."""

    def __init__(self, policy: NoisyGiver, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        super().__init__(policy, count, arrays=arrays)
        self._rngs, self._deviation = [np.random.default_rng(0)] * count, arrays.zeros((count, 7))
        config, decay = policy.config, np.exp(-policy.control_period / policy.config.time_constant)
        scale = np.array([config.rate, *[config.displacement] * 3, *[config.rotation] * 3])
        self._decay, self._scale = float(decay), np.sqrt(1.0 - decay**2) * scale

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation."""
        self._rngs[row], self._deviation[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the next random deviations."""
        noise = np.array([self._rngs[row].standard_normal(7) for row in rows.tolist()])
        deviation = self._decay * self._deviation[rows] + self._arrays.asarray(self._scale * noise)
        self._deviation[rows] = deviation
        return make_giver_actions(len(rows), deviation[:, 0], deviation[:, 1:4], deviation[:, 4:], arrays=self._arrays)


class WithdrawingBatch(ArrayPolicy[WithdrawingGiver]):
    """Batch of `WithdrawingGiver`."""

    def __init__(self, policy: WithdrawingGiver, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        super().__init__(policy, count, arrays=arrays)
        self._last_distance, self._until = arrays.full(count, math.nan), arrays.full(count, -1.0)
        self._displacement = arrays.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation."""
        self._last_distance[row], self._until[row], self._displacement[row] = math.nan, -1.0, 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that withdraw the hands, or follow the recordings."""
        xp, giver, config = self._arrays.xp, self._policy, self._policy.config
        now = widen(observation["time"][:, 0])
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        distance = widen(compute_lengths(away))
        speed = (self._last_distance[rows] - distance) / giver.control_period
        self._last_distance[rows] = distance
        # Before the second decision the speed is nan, which is not above the limit.
        is_present = observation["hand_present"][:, 0] != 0.0
        withdraws = is_present & (distance < config.max_distance) & (speed > config.max_speed)
        until = xp.where(withdraws, now + config.return_after, self._until[rows])
        withdrawal = config.withdrawal * away / compute_lengths(away).clip(1e-6)[:, None]
        displacement = xp.where(withdraws[:, None], withdrawal, self._displacement[rows])
        self._until[rows], self._displacement[rows] = until, displacement
        displacement = xp.where((now < until)[:, None], displacement, 0.0)
        return make_giver_actions(len(rows), displacement=displacement, arrays=self._arrays)


_BATCHES: dict[type[Policy], Callable[..., PolicyBatch]] = {
    ReplayGiver: ReplayBatch,
    HurriedGiver: HurriedBatch,
    StopWhenNearGiver: StopWhenNearBatch,
    HesitantGiver: HesitantBatch,
    NoisyGiver: NoisyBatch,
    WithdrawingGiver: WithdrawingBatch,
    CooperativeGiver: CooperativeBatch,
}


def make_giver_batch(policy: Policy, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> PolicyBatch | None:
    """Return the batch of a scripted giver, or None for a giver that has none.

    Args:
        policy: Giver of a single episode. A subclass of a scripted giver has no batch.
        count: Number of episodes.
        arrays: Creator of the arrays.
    """
    batch = _BATCHES.get(type(policy))
    return None if batch is None else batch(policy, count, arrays=arrays)
