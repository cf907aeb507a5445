"""Rewards of episodes that are simulated together.

The library's terms are computed for all episodes at once, a user-defined reward separately for each episode.
"""

import functools
from collections.abc import Callable, Mapping

import numpy as np

from handover_marl.envs.agents import AGENTS, GIVER, RECEIVER
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import RewardSource
from handover_marl.envs.rewards import StepData
from handover_marl.envs.transition import Transition, TransitionRecorder
from handover_marl.envs.vector.env_result import select_rows
from handover_marl.envs.wrappers.wrapper import REWARD_PREFIX
from handover_marl.episode.episode_batch import EpisodeBatch
from handover_marl.episode.observations import Observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.arrays import AnyArray, AnyIndices, to_numpy


class RewardSums:
    """Weighted reward terms of `count` episodes, summed since the last call of `clear`.

    The field `rewards` of `config` specifies the terms.
    """

    def __init__(self, config: EnvConfig, episodes: EpisodeBatch, count: int) -> None:
        self._episodes, self._count, self._arrays = episodes, count, episodes.arrays
        self._source = RewardSource(config.rewards, config.world_config.protocol.goal_center, count, episodes.arrays)
        self._recorders = [TransitionRecorder(config.control_period) for _ in range(count)]
        # Names of the k terms by agent, and sums (n, 1 + k) of the rewards and of each term.
        self._names: dict[str, list[str]] = {}
        self._sums: dict[str, AnyArray] = {}

    @property
    def totals(self) -> dict[str, AnyArray]:
        """Rewards (n,) by agent since the last `clear`."""
        return {agent: sums[:, 0] for agent, sums in self._sums.items()}

    def start(self, row: int) -> None:
        """Start the episode with index `row`, after `EpisodeBatch.update_state` has read its first state."""
        rows = self._arrays.asarray(np.array([row]))

        def start_transitions() -> list[Transition]:
            (observations,), (infos,) = self._observe(rows), self._make_infos(rows)
            return [self._recorders[row].start(observations, infos)]

        names = self._source.start(rows, self._make_step_data(rows, start_transitions))
        if not self._sums:
            self._names = {agent: list(own) for agent, own in names.items()}
            self._sums = {agent: self._arrays.zeros((self._count, 1 + len(own))) for agent, own in self._names.items()}
        self.clear(rows)

    def make_infos(self, agent: str, rows: AnyIndices) -> dict[str, AnyArray]:
        """Return the sums (r,) of an agent's reward terms since the last `clear`, by the key "reward/NAME" of infos."""
        sums = self._sums[agent][rows]
        return {f"{REWARD_PREFIX}{name}": sums[:, 1 + number] for number, name in enumerate(self._names[agent])}

    def clear(self, rows: AnyIndices) -> None:
        """Set the sums of rewards and terms in the episodes `rows` to 0."""
        for sums in self._sums.values():
            sums[rows] = 0.0

    def add(self, rows: AnyIndices, actions: Mapping[str, AnyArray], terminated: AnyArray, truncated: AnyArray) -> None:
        """Add the rewards of the last control step of the episodes `rows` (r,); first call `EpisodeBatch.update_state`.

        Actions (r, ...) by agent are float32; `terminated` and `truncated` (r,) say whether each episode has ended.
        """
        if not len(rows):
            return
        record = functools.partial(self._record_transitions, rows, actions, terminated, truncated)
        for agent, terms in self._source.compute(rows, self._make_step_data(rows, record)).items():
            columns = [terms[name] for name in self._names[agent]]
            total = sum(columns, self._arrays.zeros(len(rows)))
            self._sums[agent][rows] += self._arrays.xp.stack([total, *columns], axis=1)

    def _make_step_data(self, rows: AnyIndices, make_transitions: Callable[[], list[Transition]]) -> StepData:
        status, read_state = self._episodes.referees.status[rows], functools.partial(self._read_state, rows)
        return StepData(status, read_state, functools.cache(make_transitions))

    def _record_transitions(
        self, rows: AnyIndices, actions: Mapping[str, AnyArray], terminated: AnyArray, truncated: AnyArray
    ) -> list[Transition]:
        """Return the transition of the last control step in each of the episodes `rows`; arguments as in `add`."""
        observations, infos = self._observe(rows), self._make_infos(rows)
        actions = {agent: to_numpy(values) for agent, values in actions.items()}
        ends = zip(terminated.tolist(), truncated.tolist(), strict=True)
        return [
            self._recorders[row].record(
                observations[number],
                {agent: values[number] for agent, values in actions.items()},
                infos=infos[number],
                contacts=self._episodes.read_contacts(row),
                status=EpisodeStatus(int(infos[number][GIVER]["status"])),
                terminated=is_terminated,
                truncated=is_truncated,
            )
            for number, (row, (is_terminated, is_truncated)) in enumerate(zip(rows.tolist(), ends, strict=True))
        ]

    def _observe(self, rows: AnyIndices) -> list[dict[str, Observation]]:
        """Return the observations by agent in each of the episodes `rows`."""
        batches = {RECEIVER: self._episodes.select_state(rows), GIVER: self._episodes.select_giver_observation(rows)}
        columns = {agent: {key: to_numpy(values) for key, values in batch.items()} for agent, batch in batches.items()}
        return [select_rows(columns, number) for number in range(len(rows))]

    def _make_infos(self, rows: AnyIndices) -> list[dict[str, dict[str, float]]]:
        """Return the infos by agent, without reward terms, in each of the episodes `rows`."""
        columns = {key: values.tolist() for key, values in self._episodes.make_infos(rows).items()}
        infos = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        return [{agent: dict(info) for agent in AGENTS} for info in infos]

    def _read_state(self, rows: AnyIndices, needs_forces: bool) -> dict[str, AnyArray]:
        """Return the arrays (r, ...) that terms of the library depend on; see `StepData`."""
        episodes = self._episodes
        state = {
            **episodes.select_state(rows),
            "deviation": episodes.motion.deviation[rows],
            "holding": episodes.motion.holding[rows, None],
            "released": episodes.released[rows, None],
            "grasped": episodes.are_grasped(rows),
        }
        if needs_forces:
            contacts = [episodes.read_contacts(row) for row in rows.tolist()]
            state["robot_object_force"] = self._arrays.asarray([one.robot_object_force for one in contacts], "float64")
            state["robot_hand_force"] = self._arrays.asarray([one.robot_hand_force for one in contacts], "float64")
        return state
