"""Online choice of the goal: mirror descent over experts (Wang et al., 2020, section III-C)."""

import numpy as np
import numpy.typing as npt

from handover_marl.planning.planner_config import SelectionConfig
from handover_marl.planning.trajectory_cost import BodyCost

Array = npt.NDArray[np.float64]


class GoalSelector:
    """Learns which goal is cheap from where the trajectory is, more and more of it taken as given.

    Args:
        body: Costs of ways.
        goals: (g, 7) arm configurations.
        handicaps: (g,) what each costs beside its way.
        waypoints: Of a trajectory.
        config: Scales.
        unchecked_last: As `PlannerConfig`.
    """

    def __init__(
        self,
        body: BodyCost,
        goals: Array,
        handicaps: Array,
        waypoints: int,
        config: SelectionConfig,
        unchecked_last: bool,
    ) -> None:
        self._body, self._goals, self._handicaps = body, goals, handicaps
        self._waypoints, self._config, self._unchecked_last = waypoints, config, unchecked_last
        count = len(goals)
        self._rates = np.array(config.rates) * np.sqrt(np.log(count + 1) / config.rounds)
        self._experts = np.full((len(config.rates), count), 1.0 / count)
        self._trust = np.full(len(config.rates), 1.0 / len(config.rates))

    def first(self, trajectory: Array) -> int:
        """The goal that is cheapest from the first waypoint of a trajectory (w, 7)."""
        return int(np.argmin(self._costs(trajectory, 0)))

    def next(self, trajectory: Array, round_number: int) -> int:
        """Learn from a round, counted from 1, and choose."""
        costs = self._costs(trajectory, round_number)
        before = self._experts
        self._experts = np.stack(
            [mirror_step(expert, rate * costs) for expert, rate in zip(before, self._rates, strict=True)]
        )
        losses = self._experts @ costs + np.abs(self._experts - before).sum(axis=1)
        self._trust = self._trust * np.exp(-losses)
        self._trust /= self._trust.sum()
        return int(np.argmax(self._trust @ self._experts))

    def _costs(self, trajectory: Array, round_number: int) -> Array:
        """(g,) costs of the straight ways from a waypoint, of length 1 together."""
        first = min(int(self._config.pace * round_number), self._waypoints - 1)
        here, count = trajectory[first], self._waypoints - first
        free = np.zeros((len(self._goals), count), dtype=bool)
        free[-1 if self._unchecked_last else slice(None), -self._body.tail :] = True
        ways = self._body.of_lines(here, self._goals, count, free)
        effort = self._config.smoothness * ((self._goals - here) ** 2).sum(axis=1)
        costs = ways + effort + self._handicaps
        scaled: Array = costs / max(float(np.linalg.norm(costs)), np.finfo(np.float64).tiny)
        return scaled


def mirror_step(weights: Array, losses: Array) -> Array:
    """The distribution (n,) nearest to weights that were multiplied by exp(-losses), by shifted entropy.

    Each weight becomes max(0, (w + d) exp(l - loss) - d) with d = 1/(4 n + 1), and l such that they add up to one.
    """
    shift = 1.0 / (4 * len(weights) + 1)
    pulled = (weights + shift) * np.exp(-losses)
    # With the k largest positive, exp(l) is (1 + k d) over their sum; k is right while the k-th stays positive.
    falling = np.sort(pulled)[::-1]
    scales = (1.0 + shift * np.arange(1, len(weights) + 1)) / np.cumsum(falling)
    used = int(np.flatnonzero(falling * scales > shift)[-1])
    moved = np.maximum(0.0, pulled * scales[used] - shift)
    distribution: Array = moved / moved.sum()
    return distribution
