"""Rewards of episodes that are simulated together.

Terms of the library are computed for all episodes at once; each episode has a user-defined reward of its own.
"""

from collections.abc import Iterable, Mapping
from typing import TypeAlias

import numpy as np

from handover_marl.envs.arguments import AGENTS, GIVER, RECEIVER
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import RewardSource, make_reward_source, resolve_rewards
from handover_marl.envs.rewards import Terms, TermWeights, WeightedTerms
from handover_marl.envs.transition import TransitionRecorder
from handover_marl.envs.vector.results import select_rows
from handover_marl.envs.wrappers.wrapper import RETURN, RETURN_PREFIX, REWARD_PREFIX
from handover_marl.episode.episodes import Episodes
from handover_marl.episode.observations import Observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.arrays import AnyArray, AnyIndices, to_numpy

#: Flags (r,).
Flags: TypeAlias = AnyArray
#: Actions (r, ...), float32, by agent.
Actions: TypeAlias = Mapping[str, AnyArray]

# Indices in the sums of rewards.
_SINCE_CLEAR, _SINCE_START = 0, 1


class RewardBatch:
    """Weighted reward terms of n episodes, summed since the last call of `clear`.

    Args:
        config: Configuration of the environment, with the rewards.
        episodes: The episodes.
        count: Number n of episodes.
    """

    def __init__(self, config: EnvConfig, episodes: Episodes, count: int) -> None:
        self._episodes, self._count = episodes, count
        self._arrays = episodes.arrays
        goal, rewards = config.world_config.protocol.goal_center, resolve_rewards(config.rewards)
        self._terms: WeightedTerms | None = None
        self._sources: list[RewardSource] = []
        if isinstance(rewards, TermWeights):
            self._terms = WeightedTerms(rewards, goal, count, self._arrays)
        else:
            self._sources = [make_reward_source(rewards, goal) for _ in range(count)]
            self._recorders = [TransitionRecorder(config.control_period) for _ in range(count)]
        # Names of the terms by agent, and sums (n, 2, 1 + k) of rewards and of k terms: since the last `clear`, and
        # since the start of the episode.
        self._names: dict[str, list[str]] = {agent: [] for agent in AGENTS}
        self._sums = {agent: self._arrays.zeros((count, 2, 1)) for agent in AGENTS}

    @property
    def totals(self) -> dict[str, AnyArray]:
        """Rewards (n,) by agent."""
        return {agent: sums[:, _SINCE_CLEAR, 0] for agent, sums in self._sums.items()}

    def start(self, row: int) -> None:
        """Start an episode, whose first state has been observed.

        Raises:
            RewardError: A user-defined reward fails.
        """
        terms: Mapping[str, Iterable[str]]
        rows = self._arrays.asarray(np.array([row]))
        if self._terms is not None:
            self._terms.start(rows, self._read_state(rows))
            terms = self._terms.weights
        else:
            (observations,), (infos,) = self._observe(rows), self._make_infos(rows)
            terms = self._sources[row].start(self._recorders[row].start(observations, infos))
        for agent, agent_terms in terms.items():
            names = self._names[agent]
            new = [name for name in agent_terms if name not in names]
            if new:
                names += new
                zeros = self._arrays.zeros((self._count, 2, len(new)))
                self._sums[agent] = self._arrays.xp.concat([self._sums[agent], zeros], axis=2)
            self._sums[agent][row] = 0.0

    def make_infos(self, agent: str, rows: AnyIndices, has_returns: bool) -> dict[str, AnyArray]:
        """Return the infos of an agent in episodes: arrays (r,) of the reward terms.

        Args:
            agent: "giver" or "receiver".
            rows: Indices (r,) of the episodes.
            has_returns: Whether to include the sums since the starts of the episodes, see `EpisodeReturns`.
        """
        names, sums = self._names[agent], self._sums[agent][rows]
        infos = {f"{REWARD_PREFIX}{name}": sums[:, _SINCE_CLEAR, 1 + number] for number, name in enumerate(names)}
        if has_returns:
            infos[RETURN] = sums[:, _SINCE_START, 0]
            infos |= {f"{RETURN_PREFIX}{name}": sums[:, _SINCE_START, 1 + number] for number, name in enumerate(names)}
        return infos

    def clear(self, rows: AnyIndices) -> None:
        """Set the rewards of episodes to zero."""
        for sums in self._sums.values():
            sums[rows, _SINCE_CLEAR] = 0.0

    def add(self, rows: AnyIndices, actions: Actions, terminated: Flags, truncated: Flags) -> None:
        """Add the rewards of a control step.

        Args:
            rows: Indices (r,) of the episodes, whose states after the step have been observed.
            actions: Actions (r, ...) by agent.
            terminated: Whether each episode has terminated, (r,).
            truncated: Whether each episode was truncated, (r,).

        Raises:
            RewardError: A user-defined reward fails.
        """
        if not len(rows):
            return
        xp, values = self._arrays.xp, {}
        if self._terms is not None:
            status = self._episodes.referees.status[rows]
            for agent, terms in self._terms.compute(rows, status, self._read_state(rows)).items():
                columns = [terms[name] for name in self._names[agent]]
                total = sum(columns, self._arrays.zeros(len(rows)))
                values[agent] = xp.stack([total, *columns], axis=1)
        else:
            terms_by_episode = self._compute_terms(rows, actions, terminated, truncated)
            for agent, names in self._names.items():
                all_agent_terms = [episode_terms[agent] for episode_terms in terms_by_episode]
                value_rows = [
                    [sum(agent_terms.values(), 0.0), *(agent_terms.get(name, 0.0) for name in names)]
                    for agent_terms in all_agent_terms
                ]
                values[agent] = self._arrays.asarray(np.array(value_rows))
        for agent, sums in self._sums.items():
            sums[rows] += values[agent][:, None]

    def _compute_terms(
        self, rows: AnyIndices, actions: Actions, terminated: Flags, truncated: Flags
    ) -> list[dict[str, Terms]]:
        """Return the terms of each episode by agent."""
        numbers = rows.tolist()
        statuses = [EpisodeStatus(bits) for bits in self._episodes.referees.status[rows].tolist()]
        terms_by_episode, observations, infos = [], self._observe(rows), self._make_infos(rows)
        actions = {agent: to_numpy(values) for agent, values in actions.items()}
        ends = list(zip(terminated.tolist(), truncated.tolist(), strict=True))
        for number, row in enumerate(numbers):
            transition = self._recorders[row].record(
                observations[number],
                {agent: values[number] for agent, values in actions.items()},
                infos=infos[number],
                contacts=self._episodes.read_contacts(row),
                status=statuses[number],
                terminated=ends[number][0],
                truncated=ends[number][1],
            )
            terms_by_episode.append(self._sources[row].compute(transition))
        return terms_by_episode

    def _observe(self, rows: AnyIndices) -> list[dict[str, Observation]]:
        """Return the observations of both agents in each episode."""
        batches = {RECEIVER: self._episodes.select_state(rows), GIVER: self._episodes.select_giver_observation(rows)}
        columns = {agent: {key: to_numpy(values) for key, values in batch.items()} for agent, batch in batches.items()}
        return [select_rows(columns, number) for number in range(len(rows))]

    def _make_infos(self, rows: AnyIndices) -> list[dict[str, dict[str, float]]]:
        """Return the infos of both agents in each episode."""
        columns = {key: values.tolist() for key, values in self._episodes.make_infos(rows).items()}
        infos = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        return [{agent: dict(info) for agent in AGENTS} for info in infos]

    def _read_state(self, rows: AnyIndices) -> dict[str, AnyArray]:
        """Return the arrays (r, ...) that terms of the library depend on."""
        episodes, terms = self._episodes, self._terms
        if terms is None or not terms.needs_state:
            return {}
        state = {
            **episodes.select_state(rows),
            "deviation": episodes.motion.deviation[rows],
            "holding": episodes.motion.holding[rows, None],
            "released": episodes.released[rows, None],
            "grasped": episodes.are_grasped(rows),
        }
        if terms.needs_forces:
            contacts = [episodes.read_contacts(row) for row in rows.tolist()]
            state["object_force"] = self._arrays.asarray([one.robot_object_force for one in contacts], "float64")
            state["hand_force"] = self._arrays.asarray([one.robot_hand_force for one in contacts], "float64")
        return state
