"""Wrapper that adds up the reward terms of an episode, for training curves."""

from typing import Any

from gymnasium.utils import EzPickle

from handover_marl.envs.wrappers.wrapper import ByAgent, ParallelStep, ParallelWrapper, WrappableEnv

#: Key of the sum of all reward terms in infos.
RETURN = "return"
#: Prefixes of the keys of a reward term, and of its sum.
REWARD_PREFIX, RETURN_PREFIX = "reward/", "return/"


class EpisodeReturns(ParallelWrapper):
    """Wrapper whose infos contain the sum of each reward term since the start of the episode.

    The sum of the term `reward/NAME` is `return/NAME`, and the sum of all terms is `return`. Sums are
    not discounted; they include rewards before an action scheme first needs outputs.

    Args:
        env: Environment with reward terms in its infos.
    """

    def __init__(self, env: WrappableEnv) -> None:
        super().__init__(env)
        EzPickle.__init__(self, env)
        self._sums: dict[str, dict[str, float]] = {}

    def reset(self, seed: int | None = None, options: ByAgent | None = None) -> tuple[ByAgent, ByAgent]:
        """Start an episode with sums of 0; arguments and result as in `HandoverEnv.reset`."""
        observations, infos = super().reset(seed, options)
        self._sums = {}
        return observations, self._add_sums(infos, dict.fromkeys(infos, 0.0))

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """Let the agents act for one control period; arguments and result as in `HandoverEnv.step`."""
        observations, rewards, terminations, truncations, infos = super().step(actions)
        return observations, rewards, terminations, truncations, self._add_sums(infos, rewards)

    def _add_sums(self, infos: ByAgent, rewards: dict[str, float]) -> ByAgent:
        for agent, info in infos.items():
            sums = self._sums.setdefault(agent, {RETURN: 0.0})
            sums[RETURN] += rewards[agent]
            for key, value in info.items():
                if key.startswith(REWARD_PREFIX):
                    name = RETURN_PREFIX + key[len(REWARD_PREFIX) :]
                    sums[name] = sums.get(name, 0.0) + value
        return {agent: {**info, **self._sums[agent]} for agent, info in infos.items()}
