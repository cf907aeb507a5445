"""Preset rewards of many episodes at once, on arrays with the episode as first axis."""

from typing import Any, TypeAlias

from handover_marl.envs.arguments import GIVER, RECEIVER
from handover_marl.envs.rewards import RewardConfig
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.arrays import AnyArray, AnyIndices
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import compute_lengths, transform_points

#: Values (r,) of terms by name.
ArrayTerms: TypeAlias = dict[str, AnyArray]

# Terms with the value 1 in the step in which the status has a bit.
_OUTCOMES = {
    "task": EpisodeStatus.SUCCESS,
    "contact": EpisodeStatus.HUMAN_CONTACT,
    "drop": EpisodeStatus.OBJECT_DROP,
}
# Columns of the stored states: time (s), wrist displacement (m) and rotation (rad), whether the object is offered, and
# potentials of the shaping terms.
_TIME, _DISPLACEMENT, _ROTATION, _OFFERED, _POTENTIALS, _SIZE = 0, slice(1, 4), slice(4, 7), 7, slice(8, 11), 11


class ArrayRewards:
    """Reward function of both agents in n episodes; the terms equal those of `RewardFunction` to 1e-6.

    Args:
        config: Weights of the terms.
        goal: (3,) position to which the gripper must bring the object, world frame (m).
        episodes: The episodes, with arrays on one device as state.
        count: Number n of episodes.
    """

    def __init__(self, config: RewardConfig, goal: tuple[float, ...], episodes: Any, count: int) -> None:
        self._config, self._episodes, self._xp = config, episodes, episodes.arrays.xp
        self._goal, self._fingertips = (episodes.arrays.asarray(point, "float64") for point in (goal, FINGERTIPS))
        self._weights = {GIVER: vars(config.giver), RECEIVER: vars(config.receiver)}
        self._reads_state = any(
            weight for own in self._weights.values() for name, weight in own.items() if name not in _OUTCOMES
        )
        self._last = episodes.arrays.zeros((count, _SIZE))

    def start(self, rows: AnyIndices) -> dict[str, tuple[str, ...]]:
        """Start episodes, whose first states have been observed; return the names of the terms by agent."""
        if self._reads_state:
            self._last[rows] = self._read_state(rows)
        return {agent: tuple(weights) for agent, weights in self._weights.items()}

    def compute_terms(self, rows: AnyIndices) -> dict[str, ArrayTerms]:
        """Return the weighted reward terms of a control step by agent, and store the states after it."""
        xp, status = self._xp, self._episodes.referees.status[rows]
        values = {name: xp.astype((status & int(bit)) != 0, xp.float64) for name, bit in _OUTCOMES.items()}
        if self._reads_state:
            now, before = self._read_state(rows), self._last[rows]
            self._last[rows] = now
            values |= self._compute_giver_costs(before, now) | self._compute_guidance(before, now, status)
        zeros = xp.zeros_like(values["task"])
        return {
            agent: {name: weight * values.get(name, zeros) for name, weight in weights.items()}
            for agent, weights in self._weights.items()
        }

    def _compute_giver_costs(self, before: AnyArray, now: AnyArray) -> ArrayTerms:
        xp, change = self._xp, now - before
        period, path = change[:, _TIME], compute_lengths(change[:, _DISPLACEMENT])
        offset = compute_lengths(now[:, _DISPLACEMENT]) + compute_lengths(now[:, _ROTATION]) / 3.0
        is_later = period > 0.0
        return {
            "effort": xp.where(is_later, path**2 / xp.where(is_later, period, 1.0), 0.0),
            "discomfort": offset * period,
            "waiting": before[:, _OFFERED] * period,
        }

    def _compute_guidance(self, before: AnyArray, now: AnyArray, status: AnyArray) -> ArrayTerms:
        # A timeout truncates an episode; only termination ends its potential.
        goes_on = (status & ~int(EpisodeStatus.TIMEOUT)) == 0
        new = self._xp.where(goes_on[:, None], now[:, _POTENTIALS], 0.0)
        shaping = self._config.gamma * new - before[:, _POTENTIALS]
        return {"distance": shaping[:, 0], "grasp": shaping[:, 1], "goal": shaping[:, 2]}

    def _read_state(self, rows: AnyIndices) -> AnyArray:
        """Return the states (r, 11) at the episodes' last observation, float64."""
        xp, episodes = self._xp, self._episodes
        state, motion = episodes.state, episodes.motion
        gripper, grasped = state["gripper_pose"][rows], episodes.are_grasped(rows)
        to_object = transform_points(gripper, self._fingertips) - state["object_poses"][rows, 0, :3]
        columns = [
            state["time"][rows],
            motion.deviation[rows, 1:],
            (motion.holding[rows] & ~episodes.released[rows])[:, None],
            xp.where(grasped, 1.0, 1.0 - compute_lengths(to_object))[:, None],
            grasped[:, None],
            xp.where(grasped, 1.0 - compute_lengths(gripper[:, :3] - self._goal), 0.0)[:, None],
        ]
        return xp.concat([xp.astype(column, xp.float64) for column in columns], axis=1)
