"""Vector environment of one agent (Gymnasium's VectorEnv), and the constructor of vector environments."""

import collections
import functools
from collections.abc import Mapping
from typing import Any, Literal, overload

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate

from handover_marl.envs.config import EnvConfig, make_env_config
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.vector.batch import EnvBatch
from handover_marl.envs.vector.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.errors import OptionError, ResetNeededError, UnknownNameError
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike
from handover_marl.simulation.engines import MUJOCO

AUTORESETS = tuple(mode.name.lower() for mode in AutoresetMode)


class _PrecomputedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Wrapper that computes results of `reset` and `step` before these methods are called.

    Args:
        env: Gymnasium environment of one agent.
        autoreset: Time of the reset after an episode's end.
    """

    def __init__(self, env: SingleAgentEnv, autoreset: AutoresetMode) -> None:
        super().__init__(env)
        self._autoreset, self._ended = autoreset, False
        self._results: collections.deque[Any] = collections.deque()

    def precompute_reset(self, seed: int | None, options: dict[str, Any] | None) -> None:
        """Compute the result of the next reset."""
        self._results.clear()
        self._reset(seed, options)

    def precompute_step(self, action: Any) -> None:
        """Compute the result of the next step, including the reset after an episode's end."""
        if self._ended and self._autoreset is AutoresetMode.NEXT_STEP:
            self._reset(None, None)
            return
        result = self.env.step(action)
        self._results.append(result)
        self._ended = bool(result[2] or result[3])
        if self._ended and self._autoreset is AutoresetMode.SAME_STEP:
            self._reset(None, None)

    def _reset(self, seed: int | None, options: dict[str, Any] | None) -> None:
        self._results.append(self.env.reset(seed=seed, options=options))
        self._ended = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Return the result that `precompute_reset` computed."""
        result: tuple[Any, dict[str, Any]] = self._results.popleft()
        return result

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Return the result that `precompute_step` computed."""
        result: tuple[Any, float, bool, bool, dict[str, Any]] = self._results.popleft()
        return result


class HandoverVectorEnv(SyncVectorEnv):
    """Gymnasium vector environment of one agent, made by `handover_marl.vector_env`.

    Results equal those of Gymnasium's `SyncVectorEnv` to the bit: environment k is seeded with
    `seed + k` and behaves as a single environment with that seed.

    Args:
        batch: Environments that are simulated in lockstep.
        autoreset: Time of the reset after an episode's end.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_vector_v0"}

    def __init__(self, batch: EnvBatch, autoreset: AutoresetMode) -> None:
        self._batch = batch
        self._is_running = False
        self._precomputed = [_PrecomputedEnv(SingleAgentEnv(env), autoreset) for env in batch.envs]
        super().__init__([functools.partial(_identity, env) for env in self._precomputed], autoreset_mode=autoreset)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or in some with `options={"reset_mask": (n,) bool}`.

        Args:
            seed: Environment k gets `seed + k`; or one seed for each.
            options: Options of every single environment: `{"scene_id": n}`; and `reset_mask`.

        Raises:
            OptionError: The number of seeds or the shape of the mask is wrong.
        """
        seeds = self._batch.spread_seeds(seed)
        own = dict(options or {})
        mask = own.pop("reset_mask", None)
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if chosen.shape != (self.num_envs,):
            raise OptionError(f"reset_mask must have shape ({self.num_envs},), got {chosen.shape}")
        tasks = zip(self._precomputed, seeds, chosen, strict=True)
        # If a task fails, the states of the others are undefined: all must be reset.
        is_running, self._is_running = self._is_running or bool(chosen.all()), False
        self._batch.run_together(
            [functools.partial(env.precompute_reset, one, own or None) for env, one, resets in tasks if resets]
        )
        self._is_running = is_running
        return super().reset(seed=seeds, options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every environment for one control period, or until its action scheme needs outputs.

        Args:
            actions: (n, ...) action of each environment.

        Raises:
            ResetNeededError: There was no reset, or a reset or step has failed since.
        """
        if not self._is_running:
            raise ResetNeededError("no episodes are running; call reset() before step()")
        tasks = list(zip(self._precomputed, iterate(self.action_space, actions), strict=True))
        self._is_running = False
        self._batch.run_together([functools.partial(env.precompute_step, action) for env, action in tasks])
        self._is_running = True
        return super().step(actions)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations of all environments."""
        self._batch.close()


@overload
def vector_env(
    num_envs: int,
    agent: str = ...,
    partner: PolicyLike | None = ...,
    *,
    features: str | None = ...,
    schemes: str | None = ...,
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
    features: Mapping[str, str] | None = ...,
    schemes: Mapping[str, str] | None = ...,
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
    features: str | Mapping[str, str] | None = None,
    schemes: str | Mapping[str, str] | None = None,
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
        agent: Live agent, "receiver" or "giver", for a Gymnasium VectorEnv; None for both agents.
        partner: Policy of the other agent; default: "replay" for a giver, "yang2021" for a receiver.
        features: Name of the features that replace observations, of the live agent or by agent.
        schemes: Name of the action scheme that replaces actions, of the live agent or by agent.
        autoreset: Time of the reset after an episode's end as in Gymnasium: "next_step", "same_step" or
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
    if autoreset not in AUTORESETS:
        raise UnknownNameError("autoreset", autoreset, AUTORESETS)
    mode = AutoresetMode[autoreset.upper()]
    if config is None:
        fields = {"physics": MUJOCO, **fields}
    batch = EnvBatch(make_env_config(config, fields), num_envs, agent, partner, features, schemes, threads, trust)
    return ParallelVectorEnv(batch, mode) if agent is None else HandoverVectorEnv(batch, mode)


def _identity(env: _PrecomputedEnv) -> _PrecomputedEnv:
    return env
