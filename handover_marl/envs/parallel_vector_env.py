"""Many environments of both agents in one: PettingZoo's parallel API with arrays in place of single values."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from handover_marl.envs.fleet import Fleet
from handover_marl.envs.wrapper import ParallelStep
from handover_marl.errors import ActionError, ResetNeededError

ByAgent = dict[str, Any]
BatchStep = tuple[ByAgent, ByAgent, ByAgent, ByAgent, ByAgent]


class ParallelVectorEnv:
    """Both agents of many environments, simulated at once. Made by `handover_marl.vector_env(..., agent=None)`.

    As PettingZoo's parallel API, with arrays (n, ...) of n environments in the dicts by agent. Environments begin
    anew as Gymnasium specifies: "next_step" ignores the actions that follow an end, returns the first observations
    of the next episode and rewards of 0; "same_step" returns them with the end's rewards, and what was seen and told
    last in `infos[agent]["final_obs"]` (n) and `["final_info"]` (n), with `["_final_obs"]` (n) saying where.

    Args:
        fleet: The environments.
        autoreset: When an environment begins anew after an episode's end.

    Attributes:
        num_envs: How many there are.
        possible_agents: Names of the agents; they are there in all environments at all times.
        metadata: As of a single environment, and `autoreset_mode`.
    """

    def __init__(self, fleet: Fleet, autoreset: AutoresetMode) -> None:
        self._fleet, self._autoreset = fleet, autoreset
        self.num_envs = len(fleet.envs)
        first = fleet.envs[0]
        self.possible_agents: list[str] = list(first.possible_agents)
        self.metadata: dict[str, Any] = {**first.metadata, "autoreset_mode": autoreset}
        self._ended = np.ones(self.num_envs, dtype=bool)
        self._begun = False

    @property
    def agents(self) -> list[str]:
        """The agents, once there was a reset."""
        return self.possible_agents if self._begun else []

    def single_observation_space(self, agent: str) -> spaces.Space[Any]:
        """An agent's observation space in one environment."""
        return self._fleet.envs[0].observation_space(agent)

    def single_action_space(self, agent: str) -> spaces.Box:
        """An agent's action space in one environment."""
        return self._fleet.envs[0].action_space(agent)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """An agent's observation space in all environments, (n, ...)."""
        return batch_space(self.single_observation_space(agent), self.num_envs)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """An agent's action space in all environments, (n, ...)."""
        return batch_space(self.single_action_space(agent), self.num_envs)

    def reset(
        self, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ByAgent, ByAgent]:
        """Start an episode in every environment.

        Args:
            seed: Environment k gets `seed + k`; or a list of seeds.
            options: As of a single environment: `{"scene_id": n}`.

        Raises:
            OptionError: There are more or fewer seeds than environments.
        """
        given = self._fleet.seeds(seed)
        self._begun = False
        found = self._fleet.together(
            [functools.partial(env.reset, one, options) for env, one in zip(self._fleet.envs, given, strict=True)]
        )
        self._begun, self._ended = True, np.zeros(self.num_envs, dtype=bool)
        return self._joined([seen for seen, _ in found]), self._infos([infos for _, infos in found])

    def step(self, actions: ByAgent) -> BatchStep:
        """Act in every environment.

        Args:
            actions: By agent, (n, ...) each.

        Raises:
            ActionError: An agent's actions are missing or malformed.
            ResetNeededError: There was no reset, or an episode has ended and "disabled" leaves resets to you.
        """
        if not self._begun:
            raise ResetNeededError("no episode is running; call reset() before step()")
        each = self._each(actions)
        self._begun = False
        tasks = [
            self._task(number, {agent: row[number] for agent, row in each.items()}) for number in range(self.num_envs)
        ]
        found = self._fleet.together(tasks)
        self._begun = True
        results = [result for result, _ in found]
        seen = [result[0] if begun is None else begun[0] for result, begun in found]
        self._ended = np.array([any(result[2].values()) or any(result[3].values()) for result in results])
        infos = self._infos([result[4] if begun is None else begun[1] for result, begun in found])
        if self._autoreset is AutoresetMode.SAME_STEP and self._ended.any():
            for agent in self.possible_agents:
                seen_last, told_last = (np.full(self.num_envs, None, dtype=object) for _ in range(2))
                for number in np.flatnonzero(self._ended):
                    seen_last[number], told_last[number] = results[number][0][agent], results[number][4][agent]
                infos[agent] |= {"final_obs": seen_last, "final_info": told_last, "_final_obs": self._ended.copy()}
            self._ended = np.zeros(self.num_envs, dtype=bool)
        rewards, ended, timed_out = (
            {agent: np.array([result[part][agent] for result in results]) for agent in self.possible_agents}
            for part in (1, 2, 3)
        )
        return self._joined(seen), rewards, ended, timed_out, infos

    def close(self) -> None:
        """Free all simulations."""
        self._begun = False
        self._fleet.close()

    def _task(self, number: int, actions: ByAgent) -> Callable[[], tuple[ParallelStep, tuple[ByAgent, ByAgent] | None]]:
        env, agents = self._fleet.envs[number], self.possible_agents
        if self._ended[number] and self._autoreset is AutoresetMode.NEXT_STEP:

            def begin() -> tuple[ParallelStep, None]:
                seen, infos = env.reset()
                no = dict.fromkeys(agents, False)
                return (seen, dict.fromkeys(agents, 0.0), no, no, infos), None

            return begin

        def act() -> tuple[ParallelStep, tuple[ByAgent, ByAgent] | None]:
            result: ParallelStep = env.step(actions)
            over = any(result[2].values()) or any(result[3].values())
            return result, env.reset() if over and self._autoreset is AutoresetMode.SAME_STEP else None

        return act

    def _each(self, actions: ByAgent) -> dict[str, list[npt.NDArray[Any]]]:
        if not isinstance(actions, dict) or actions.keys() != set(self.possible_agents):
            raise ActionError(f"step() takes a dict of arrays for {' and '.join(self.possible_agents)}")
        rows = {}
        for agent, given in actions.items():
            wanted = (self.num_envs, *self.single_action_space(agent).shape)
            if np.shape(given) != wanted:
                raise ActionError(f"the {agent}'s actions have shape {np.shape(given)}; expected {wanted}")
            rows[agent] = list(iterate(self.action_space(agent), np.asarray(given)))
        return rows

    def _joined(self, seen: list[ByAgent]) -> ByAgent:
        joined = {}
        for agent in self.possible_agents:
            space = self.single_observation_space(agent)
            room: Any = create_empty_array(space, n=self.num_envs)
            joined[agent] = concatenate(space, [one[agent] for one in seen], room)
        return joined

    def _infos(self, infos: list[ByAgent]) -> ByAgent:
        return {
            agent: {key: np.array([one[agent][key] for one in infos]) for key in infos[0][agent]}
            for agent in self.possible_agents
        }
