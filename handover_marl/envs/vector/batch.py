"""Batch of handover environments that are simulated in lockstep."""

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import TypeVar

import numpy as np

from handover_marl.envs.arguments import check_positive_integer
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.encode import encode
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.envs.wrappers.wrapper import ParallelWrapper
from handover_marl.errors import OptionError
from handover_marl.execution.options import count_available_cores
from handover_marl.policies.reference import PolicyLike

_Result = TypeVar("_Result")


class EnvBatch:
    """Batch of environments with one configuration that are simulated in lockstep.

    Args:
        config: Configuration of each environment.
        num_envs: Number of environments.
        agent: Live agent, "receiver" or "giver"; None for both.
        partner: Policy of the other agent if one is live; default: "replay" or "yang2021".
        features: Name of the features by agent, or of the live agent's; None for plain observations.
        schemes: Name of the action scheme by agent, or of the live agent's; None for plain actions.
        threads: Number of simulation threads; default: one per core.
        trust: Whether a policy file may run code.

    Attributes:
        envs: Environments of the batch.

    Raises:
        OptionError: A number is out of range, a partner is given for two live agents, windows are
            requested, or a package is missing.
    """

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int,
        agent: str | None,
        partner: PolicyLike | None,
        features: str | Mapping[str, str] | None,
        schemes: str | Mapping[str, str] | None,
        threads: int | None,
        trust: bool,
    ) -> None:
        count = check_positive_integer("num_envs", num_envs)
        threads = check_positive_integer("threads", count_available_cores() if threads is None else threads)
        if agent is None and partner is not None:
            raise OptionError("partner must be None if both agents are live; leave it out, or name the live agent")
        if config.render_mode == "human":
            raise OptionError('render_mode must be None or "rgb_array" for several environments, got "human"')

        def make() -> HandoverEnv | ParallelWrapper:
            env: HandoverEnv | ParallelWrapper = HandoverEnv(config)
            if agent is not None:
                env = freeze(env, agent, partner, trust=trust)
            return env if features is None and schemes is None else encode(env, features, schemes)

        self.envs = [make() for _ in range(count)]
        if find_spec("greenlet") is None:
            raise OptionError("vector environments need greenlet: pip install 'handover-marl[mujoco]'")
        # Imported after the check, because it needs greenlet.
        from handover_marl.episode.lockstep import LockstepScheduler

        self._scheduler = LockstepScheduler(config.physics, config.world_config, count, threads)
        for index, env in enumerate(self.envs):
            env.unwrapped.join_lockstep(self._scheduler, index)

    def spread_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Derive one seed for each environment from a seed or a sequence of seeds.

        Args:
            seed: Environment k gets `seed + k`; or one seed for each; None keeps the state
                of all random generators.

        Raises:
            OptionError: The number of seeds is not the number of environments.
        """
        count = len(self.envs)
        if seed is None:
            return [None] * count
        seeds: list[int | None] = []
        if isinstance(seed, (int, np.integer)):
            seeds += range(int(seed), int(seed) + count)
        else:
            seeds += seed
        if len(seeds) != count:
            raise OptionError(f"seed must be an integer or {count} seeds, got {len(seeds)} seeds")
        return seeds

    def run_together(self, tasks: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Run tasks in lockstep, each resets or steps another environment; return their results."""
        return self._scheduler.run_together(tasks)

    def close(self) -> None:
        """Free the simulations of all environments."""
        for env in self.envs:
            env.close()
        self._scheduler.close()
