"""Batch of handover environments that are simulated in lockstep."""

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from handover_marl.envs.arguments import check_positive_integer
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.encode import encode
from handover_marl.envs.wrappers.freeze import freeze
from handover_marl.envs.wrappers.wrapper import ByAgent, ParallelStep, WrappableEnv, check_env
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SimulationError
from handover_marl.execution.options import count_available_cores, require_modules
from handover_marl.learning.encodings.own_features import FeaturesLike
from handover_marl.learning.encodings.own_schemes import SchemeLike
from handover_marl.policies.reference import PolicyLike

#: Largest number of environments in a batch; each takes megabytes of memory.
MAX_ENVS = 65_536

#: Function or class that wraps the environment by a `pettingzoo.utils.BaseParallelWrapper`.
WrapperFunction: TypeAlias = Callable[[WrappableEnv], WrappableEnv]
ResetResult = tuple[ByAgent, ByAgent]
_BUSY = "another thread is using the vector environment; call reset() and step() in turn"


class EnvBatch:
    """Batch of environments with one configuration that are simulated in lockstep.

    Args:
        config: Configuration of each environment.
        num_envs: Number of environments.
        autoreset: Gymnasium's mode of the reset after an episode's end.
        agent: Agent that is controlled from outside, "receiver" or "giver"; None for both.
        partner: Policy of the other agent if only one is controlled from outside; default: "replay"
            for a giver, "yang2021" for a receiver.
        features: Features that replace observations, see `encode`; a mapping by agent if both agents
            are controlled; None leaves observations as they are.
        schemes: Action scheme whose outputs replace actions, see `encode`; a mapping by agent if both
            agents are controlled; None leaves actions as they are.
        threads: Number of simulation threads; default: one per core.
        trust: Whether a policy file may run code.
        wrappers: Functions or classes that wrap each environment, which has both agents, the innermost
            first; `partner`, `features` and `schemes` are applied after them.

    Attributes:
        envs: Environments of the batch.
        autoreset: Gymnasium's mode of the reset after an episode's end.
        is_running: Whether every environment has been reset, and no reset or step has failed since.

    Raises:
        OptionError: A number is out of range, a partner is given although both agents are controlled
            from outside, windows are requested, or a package is missing.
    """

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int,
        autoreset: AutoresetMode,
        agent: str | None,
        partner: PolicyLike | None,
        features: FeaturesLike | Mapping[str, FeaturesLike] | None,
        schemes: SchemeLike | Mapping[str, SchemeLike] | None,
        threads: int | None,
        trust: bool,
        wrappers: Sequence[WrapperFunction] = (),
    ) -> None:
        count = check_positive_integer("num_envs", num_envs)
        if count > MAX_ENVS:
            raise OptionError(f"num_envs must be at most {MAX_ENVS}, got {num_envs}; run several processes")
        threads = check_positive_integer("threads", count_available_cores() if threads is None else threads)
        if agent is None and partner is not None:
            raise OptionError(
                f"partner must be None if both agents are controlled, got {partner!r}; leave it out, or name one agent"
            )
        given: object = wrappers
        if not isinstance(given, Sequence) or isinstance(given, str):
            raise OptionError(f"wrappers must be a list of functions or classes, got {wrappers!r}")
        if config.render_mode == "human":
            raise OptionError('render_mode must be None or "rgb_array" for several environments, got "human"')

        def make() -> WrappableEnv:
            env: WrappableEnv = HandoverEnv(config)
            for wrapper in wrappers:
                env = _apply_wrapper(wrapper, env)
            if agent is not None:
                env = freeze(env, agent, partner, trust=trust)
            return env if features is None and schemes is None else encode(env, features, schemes)

        self.autoreset, self.is_running = autoreset, False
        self._is_closed, self._process, self._lock = False, os.getpid(), threading.Lock()
        self.envs = [make() for _ in range(count)]
        self._ended = np.zeros(count, dtype=bool)
        require_modules("a vector environment", "mujoco", "greenlet")
        # Imported after the check, because it needs greenlet.
        from handover_marl.episode.lockstep import LockstepScheduler

        self._scheduler = LockstepScheduler(config.physics, config.world_config, count, threads)
        for index, env in enumerate(self.envs):
            env.unwrapped.join_lockstep(self._scheduler, index)

    def reset(
        self,
        seed: int | Sequence[int | None] | None,
        options: dict[str, Any] | None,
        chosen: npt.NDArray[np.bool_] | None = None,
    ) -> list[ResetResult]:
        """Start an episode in every environment, or in some, and return their observations and infos.

        Args:
            seed: Seed of the first environment, environment k gets `seed + k`; or a sequence with a
                seed for each environment; None keeps the state of all random generators.
            options: Options of `reset` that every environment gets.
            chosen: (n,) mask of the environments to reset; default: all.

        Raises:
            OptionError: The number of seeds is not the number of environments, a seed is not an integer,
                or `options` is not a mapping.
            ResetNeededError: The environments are closed, or were made by another process.
            SimulationError: Another thread is using the environments.
        """
        self._require_usable()
        if options is not None and not isinstance(options, Mapping):
            raise OptionError(f"options must be a dict, got {options!r}")
        chosen = np.ones(len(self.envs), dtype=bool) if chosen is None else chosen
        tasks = zip(self.envs, self._spread_seeds(seed), chosen, strict=True)
        # If a task fails, the states of the others are undefined: all must be reset.
        with self._exclude_other_threads():
            is_running, self.is_running = self.is_running or bool(chosen.all()), False
            results: list[ResetResult] = self._scheduler.run_together(
                [functools.partial(env.reset, one, options or None) for env, one, resets in tasks if resets]
            )
            self.is_running, self._ended = is_running, self._ended & ~chosen
        return results

    def require_running(self) -> None:
        """Check that every environment can be stepped.

        Raises:
            ResetNeededError: There was no reset, or a reset or step has failed since.
            SimulationError: Another thread is using the environments.
        """
        self._require_usable()
        if not self.is_running:
            raise ResetNeededError("no episode is running; call reset() before step()")

    def step(self, actions: Sequence[ByAgent]) -> list[tuple[ParallelStep | None, ResetResult | None]]:
        """Step every environment, and reset those whose episode has ended as `autoreset` specifies.

        Args:
            actions: Actions by agent, for each environment.

        Returns:
            For each environment the result of its step, or None if it was only reset, and the result
            of its reset, or None if it was not reset.
        """
        tasks = zip(self.envs, self._ended, actions, strict=True)
        with self._exclude_other_threads():
            self.is_running = False
            outcomes = self._scheduler.run_together([functools.partial(self._step_one, *task) for task in tasks])
            self.is_running = True
            self._ended = np.array([reset is None and _has_ended(result) for result, reset in outcomes])
        return outcomes

    def close(self) -> None:
        """Free the simulations of all environments."""
        self.is_running, self._is_closed = False, True
        for env in self.envs:
            env.close()
        self._scheduler.close()

    def _require_usable(self) -> None:
        if self._is_closed:
            raise ResetNeededError("the vector environment is closed; make another one")
        if os.getpid() != self._process:
            # Threads do not survive a fork, so the simulation would wait for them forever.
            raise ResetNeededError("the vector environment was made by another process; make it after the fork")
        if self._lock.locked():
            raise SimulationError(_BUSY)

    @contextlib.contextmanager
    def _exclude_other_threads(self) -> Iterator[None]:
        if not self._lock.acquire(blocking=False):
            raise SimulationError(_BUSY)
        try:
            yield
        finally:
            self._lock.release()

    def _step_one(
        self, env: WrappableEnv, ended: bool, actions: ByAgent
    ) -> tuple[ParallelStep | None, ResetResult | None]:
        if ended and self.autoreset is AutoresetMode.NEXT_STEP:
            return None, env.reset()
        result = env.step(actions)
        return result, env.reset() if self.autoreset is AutoresetMode.SAME_STEP and _has_ended(result) else None

    def _spread_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """Derive one seed for each environment from a seed or a sequence of seeds."""
        count = len(self.envs)
        if seed is None:
            return [None] * count
        if isinstance(seed, (int, np.integer)):
            return list(range(int(seed), int(seed) + count))
        seeds = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else [seed]
        if len(seeds) != count or not all(one is None or isinstance(one, (int, np.integer)) for one in seeds):
            raise OptionError(f"seed must be an integer or {count} seeds (integers), got {seed!r}")
        return [None if one is None else int(one) for one in seeds]


def split_actions(actions: object, space: spaces.Space[Any], count: int, agent: str) -> list[npt.NDArray[Any]]:
    """Check the actions of all environments and return one row for each.

    Args:
        actions: Actions (count, ...) of an agent.
        space: Action space of the agent in one environment.
        count: Number of environments.
        agent: Name of the agent, for errors.

    Raises:
        ActionError: The actions are not a numeric array of this shape.
    """
    shape = (count, *(space.shape or ()))
    try:
        values = np.asarray(actions)
    except (ValueError, TypeError, RuntimeError) as error:  # ragged lists, tensors with a gradient or on a GPU
        raise ActionError(f"actions of the {agent} must be an array of shape {shape} ({error})") from error
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise ActionError(f"actions of the {agent} must have shape {shape}, got {values.dtype} {values.shape}")
    return list(values)


def _apply_wrapper(wrapper: WrapperFunction, env: WrappableEnv) -> WrappableEnv:
    if not callable(wrapper):
        raise OptionError(f"wrappers must be functions or classes that wrap an environment, got {wrapper!r}")
    wrapped = wrapper(env)
    check_env(wrapped)
    if wrapped.unwrapped is not env.unwrapped:
        raise OptionError(f"wrappers must wrap the environment that they get, got another one from {wrapper!r}")
    return wrapped


def _has_ended(result: ParallelStep | None) -> bool:
    return result is not None and (any(result[2].values()) or any(result[3].values()))
