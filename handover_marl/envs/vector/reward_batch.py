"""Rewards of episodes that are simulated together; each episode has a reward function of its own."""

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.envs.arguments import AGENTS, GIVER, RECEIVER
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import make_reward_source, resolve_rewards
from handover_marl.envs.rewards import RewardConfig, RewardFunction, RewardState, Terms
from handover_marl.envs.transition import TransitionRecorder
from handover_marl.episode.batch.episodes import EpisodeBatch
from handover_marl.episode.observations import Observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import transform_points

#: Name of the sum of rewards in infos; the sum of a term is `return/NAME`.
RETURN = "return"

Rows = npt.NDArray[np.int_]
Flags = npt.NDArray[np.bool_]
Actions = Mapping[str, npt.NDArray[np.float32]]


class RewardBatch:
    """Weighted reward terms of n episodes, summed since the last call of `clear`.

    Args:
        config: Configuration of the environment, with the rewards.
        episodes: The episodes.
        count: Number n of episodes.

    Attributes:
        totals: Rewards (n,) by agent.
        terms: Reward terms by agent and name: arrays (n,); without names before the first `start`.
    """

    def __init__(self, config: EnvConfig, episodes: EpisodeBatch, count: int) -> None:
        self._episodes, self._count = episodes, count
        goal, rewards = config.world_config.protocol.goal_center, resolve_rewards(config.rewards)
        self._functions: list[RewardFunction] = []
        self._sources: list[Any] = []
        if isinstance(rewards, RewardConfig):
            self._functions = [RewardFunction(rewards, goal) for _ in range(count)]
        else:
            self._sources = [make_reward_source(rewards, goal) for _ in range(count)]
            self._recorders = [TransitionRecorder(config.control_period) for _ in range(count)]
        self.totals = {agent: np.zeros(count) for agent in AGENTS}
        self.terms: dict[str, dict[str, npt.NDArray[np.float64]]] = {agent: {} for agent in AGENTS}
        self._returns = {agent: {RETURN: np.zeros(count)} for agent in AGENTS}

    def start(self, row: int) -> None:
        """Start an episode, whose first state has been observed.

        Raises:
            RewardError: A user-defined reward fails.
        """
        if self._functions:
            terms = self._functions[row].reset(self._read_state(row))
        else:
            (observations,) = self._observe(np.array([row]))
            terms = self._sources[row].start(self._recorders[row].start(observations, self._make_infos(row)))
        for agent, own in terms.items():
            for name in [name for name in own if name not in self.terms[agent]]:
                self.terms[agent][name] = np.zeros(self._count)
                self._returns[agent][f"{RETURN}/{name}"] = np.zeros(self._count)
            for sums in self._returns[agent].values():
                sums[row] = 0.0
        self.clear(np.array([row]))

    def make_infos(self, agent: str, rows: Rows, has_returns: bool) -> dict[str, npt.NDArray[np.float64]]:
        """Return the infos of an agent in episodes: arrays (r,) of the reward terms.

        Args:
            agent: "giver" or "receiver".
            rows: Indices (r,) of the episodes.
            has_returns: Whether to include the sums since the starts of the episodes, see `EpisodeReturns`.
        """
        infos = {f"reward/{name}": values[rows] for name, values in self.terms[agent].items()}
        returns = {name: sums[rows] for name, sums in self._returns[agent].items()} if has_returns else {}
        return {**infos, **returns}

    def clear(self, rows: Rows) -> None:
        """Set the rewards of episodes to zero."""
        for agent in AGENTS:
            for array in (self.totals[agent], *self.terms[agent].values()):
                array[rows] = 0.0

    def add(self, rows: Rows, actions: Actions, terminated: Flags, truncated: Flags) -> None:
        """Add the rewards of a control step.

        Args:
            rows: Indices (r,) of the episodes, whose states after the step have been observed.
            actions: Actions (r, ...) by agent.
            terminated: Whether each episode has terminated, (r,).
            truncated: Whether each episode was truncated, (r,).

        Raises:
            RewardError: A user-defined reward fails.
        """
        observations = self._observe(rows) if self._sources else []
        for number, (row, bits) in enumerate(zip(rows.tolist(), self._episodes.referees.status[rows], strict=True)):
            status = EpisodeStatus(int(bits))
            if self._functions:
                read_state = functools.partial(self._read_state, row)
                self._add_terms(row, self._functions[row].compute_terms(status, read_state))
                continue
            transition = self._recorders[row].record(
                observations[number],
                {agent: values[number] for agent, values in actions.items()},
                infos=self._make_infos(row),
                contacts=self._episodes.read_contacts(row),
                status=status,
                terminated=bool(terminated[number]),
                truncated=bool(truncated[number]),
            )
            self._add_terms(row, self._sources[row].compute(transition))

    def _add_terms(self, row: int, terms: dict[str, Terms]) -> None:
        for agent, own in terms.items():
            for name, value in own.items():
                self.terms[agent][name][row] += value
                self._returns[agent][f"{RETURN}/{name}"][row] += value
            reward = sum(own.values(), 0.0)
            self.totals[agent][row] += reward
            self._returns[agent][RETURN][row] += reward

    def _observe(self, rows: Rows) -> list[dict[str, Observation]]:
        """Return the observations of both agents in each episode."""
        found = {RECEIVER: self._episodes.select_state(rows), GIVER: self._episodes.select_giver_observation(rows)}
        return [
            {agent: {key: values[number] for key, values in own.items()} for agent, own in found.items()}
            for number in range(len(rows))
        ]

    def _make_infos(self, row: int) -> dict[str, dict[str, float]]:
        own = {key: values.item() for key, values in self._episodes.make_infos(np.array([row])).items()}
        return {agent: dict(own) for agent in AGENTS}

    def _read_state(self, row: int) -> RewardState:
        episodes = self._episodes
        state, motion = episodes.state, episodes.motion
        gripper = state["gripper_pose"][row]
        return RewardState(
            time=float(state["time"][row, 0]),
            gripper=tuple(gripper[:3].tolist()),
            fingertip_center=tuple(transform_points(gripper, FINGERTIPS).tolist()),
            object_position=tuple(state["object_poses"][row, 0, :3].tolist()),
            grasped=episodes.read_contacts(row).both_fingers_touch,
            deviation=tuple(motion.deviation[row, 1:].tolist()),
            object_offered=bool(motion.holding[row] and not episodes.released[row]),
        )
