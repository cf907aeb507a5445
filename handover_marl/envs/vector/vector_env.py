"""Vector environment of one agent (Gymnasium's VectorEnv), and the constructor of vector environments."""

import collections
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, overload

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from handover_marl.envs.config import EnvConfig, make_env_config
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.batch import EnvBatch, WrapperFunction, split_actions
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.wrappers.wrapper import ByAgent, ParallelWrapper, SingleAgentEnv
from handover_marl.errors import OptionError, check_name
from handover_marl.execution.options import forward_signature
from handover_marl.learning.encodings.own_features import FeaturesLike
from handover_marl.learning.encodings.own_schemes import SchemeLike
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.engines import MUJOCO

AUTORESETS = tuple(mode.name.lower() for mode in AutoresetMode)


class _PrecomputedEnv(SingleAgentEnv):
    """Environment whose results of `reset` and `step` are computed before these methods are called.

    Args:
        env: Parallel environment of one agent.

    Attributes:
        results: Results by agent, in the order in which they will be returned.
    """

    def __init__(self, env: ParallelWrapper) -> None:
        super().__init__(env)
        self.results: collections.deque[tuple[ByAgent, ...]] = collections.deque()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return the next result, which is that of a reset."""
        return tuple(part[self.agent] for part in self.results.popleft())

    def step(self, action: Any) -> Any:
        """Return the next result, which is that of a step."""
        return tuple(part[self.agent] for part in self.results.popleft())


class HandoverVectorEnv(SyncVectorEnv):
    """Gymnasium vector environment of one agent, made by `handover_marl.vector_env`.

    Results equal those of Gymnasium's `SyncVectorEnv` bit for bit: environment k is seeded with
    `seed + k` and behaves as a single environment with that seed.

    Args:
        batch: Environments that are simulated in lockstep.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_vector_v0"}

    def __init__(self, batch: EnvBatch) -> None:
        self._batch = batch
        self._precomputed = [_PrecomputedEnv(env) for env in batch.envs]
        super().__init__(
            [functools.partial(_identity, env) for env in self._precomputed], autoreset_mode=batch.autoreset
        )

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in some with `options={"reset_mask": (n,) bool}`.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a list with a seed
                for each environment.
            options: Options that every environment gets: `{"scene_id": n}` chooses the scene; and
                `reset_mask`, the mask of the environments to reset.

        Raises:
            OptionError: The number of seeds or the shape of the mask is wrong.
            ResetNeededError: The environments are closed, or were made by another process.
        """
        if options is not None and not isinstance(options, Mapping):
            raise OptionError(f"options must be a dict, got {options!r}")
        own = dict(options or {})
        mask = own.pop("reset_mask", None)
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != bool or not chosen.any():
            raise OptionError(f"reset_mask must be {self.num_envs} truth values with at least one True, got {mask!r}")
        results = iter(self._batch.reset(seed, own, chosen))
        for env, resets in zip(self._precomputed, chosen, strict=True):
            env.results = collections.deque([next(results)] if resets else [])
        return super().reset(options=None if mask is None else own | {"reset_mask": chosen})

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every environment for one control period, or until its action scheme needs outputs.

        Args:
            actions: (n, ...) action of each environment.

        Raises:
            ActionError: The actions are not a numeric array (n, ...).
            ResetNeededError: There was no reset, or a reset or step has failed since.
        """
        self._batch.require_running()
        agent = self._precomputed[0].agent
        split = split_actions(actions, self.single_action_space, self.num_envs, agent)
        rows = [{agent: row} for row in split]
        for env, outcome in zip(self._precomputed, self._batch.step(rows), strict=True):
            env.results.extend(result for result in outcome if result is not None)
        return super().step(np.stack(split))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations of all environments."""
        self._batch.close()


@overload
def vector_env(
    num_envs: int,
    agent: str = ...,
    partner: PolicyLike | None = ...,
    *,
    features: FeaturesLike | None = ...,
    schemes: SchemeLike | None = ...,
    wrappers: Sequence[WrapperFunction] = ...,
    autoreset: str = ...,
    threads: int | None = ...,
    trust: bool = ...,
    config: EnvConfig | None = ...,
    **fields: Any,
) -> HandoverVectorEnv: ...


@overload
def vector_env(
    num_envs: int,
    agent: Literal[None],
    partner: None = ...,
    *,
    features: Mapping[str, FeaturesLike] | None = ...,
    schemes: Mapping[str, SchemeLike] | None = ...,
    wrappers: Sequence[WrapperFunction] = ...,
    autoreset: str = ...,
    threads: int | None = ...,
    trust: bool = ...,
    config: EnvConfig | None = ...,
    **fields: Any,
) -> ParallelVectorEnv: ...


@forward_signature(EnvConfig, defaults={"physics": MUJOCO})
def vector_env(
    num_envs: int,
    agent: str | None = "receiver",
    partner: PolicyLike | None = None,
    *,
    features: FeaturesLike | Mapping[str, FeaturesLike] | None = None,
    schemes: SchemeLike | Mapping[str, SchemeLike] | None = None,
    wrappers: Sequence[WrapperFunction] = (),
    autoreset: str = "next_step",
    threads: int | None = None,
    trust: bool = False,
    config: EnvConfig | None = None,
    **fields: Any,
) -> HandoverVectorEnv | ParallelVectorEnv:
    """Make many environments in one process, which MuJoCo simulates in lockstep on several threads.

    Each environment behaves as a single one with its seed, whatever the number of environments and threads.

    Args:
        num_envs: Number of environments.
        agent: Agent that is controlled from outside, "receiver" or "giver", for a Gymnasium VectorEnv;
            None for both agents.
        partner: Policy of the other agent; default: "replay" for a giver, "yang2021" for a receiver.
        features: Features that replace observations, a name, class or function as in `encode`; a mapping
            by agent for both agents.
        schemes: Action scheme whose outputs replace actions, a name, class or function as in `encode`; a
            mapping by agent for both agents.
        wrappers: Functions or classes that wrap each environment by a
            `pettingzoo.utils.BaseParallelWrapper`, the innermost first; the wrapped environment has both
            agents, their observations and actions as the environment defines them.
        autoreset: Gymnasium's mode of the reset after an episode's end: "next_step", "same_step" or
            "disabled".
        threads: Number of simulation threads; default: one per core.
        trust: Whether a policy file may run code.
        config: Configuration of each environment; default: one made of `fields`.
        fields: Fields of `handover_marl.envs.config.EnvConfig`, in place of `config`; `physics`
            defaults to "mujoco".

    Raises:
        UnknownNameError: There is no such agent, policy, features, scheme or autoreset mode.
        OptionError: A number is out of range, or MuJoCo is not installed.
    """
    check_name("autoreset", autoreset, AUTORESETS)
    mode = AutoresetMode[autoreset.upper()]
    if config is None:
        fields = {"physics": MUJOCO, **fields}
    batch = EnvBatch(
        make_env_config(config, fields), num_envs, mode, agent, partner, features, schemes, threads, trust, wrappers
    )
    return ParallelVectorEnv(batch) if agent is None else HandoverVectorEnv(batch)


def _identity(env: _PrecomputedEnv) -> _PrecomputedEnv:
    return env
