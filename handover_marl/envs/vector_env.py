"""Many environments in one, of one agent (Gymnasium's VectorEnv) or of both (dicts of arrays by agent)."""

import collections
import functools
from collections.abc import Mapping
from typing import Any, Literal, overload

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate
from typing_extensions import Unpack

from handover_marl.envs.constructors import EnvOptions
from handover_marl.envs.fleet import Fleet
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.parallel_vector_env import ParallelVectorEnv
from handover_marl.envs.wrapper import SingleAgentEnv
from handover_marl.errors import OptionError, ResetNeededError, UnknownNameError
from handover_marl.options import shows
from handover_marl.policies.reference import PolicyLike
from handover_marl.sim.engines import MUJOCO

AUTORESETS = tuple(mode.name.lower() for mode in AutoresetMode)


class _Ahead(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose next results were worked out before they are asked for.

    Args:
        env: The environment.
        autoreset: When it begins anew after an episode's end.
    """

    def __init__(self, env: SingleAgentEnv, autoreset: AutoresetMode) -> None:
        super().__init__(env)
        self._autoreset, self._ended = autoreset, False
        self._results: collections.deque[Any] = collections.deque()

    def reset_ahead(self, seed: int | None, options: dict[str, Any] | None) -> None:
        """Work out a reset."""
        self._results.clear()
        self._reset(seed, options)

    def step_ahead(self, action: Any) -> None:
        """Work out a step, with the reset that comes with it or in its place."""
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
        """The reset that was worked out."""
        found: tuple[Any, dict[str, Any]] = self._results.popleft()
        return found

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """The step that was worked out."""
        found: tuple[Any, float, bool, bool, dict[str, Any]] = self._results.popleft()
        return found


class HandoverVectorEnv(SyncVectorEnv):
    """Many environments of one agent, simulated at once: Gymnasium's SyncVectorEnv otherwise, to the bit.

    Made by `handover_marl.vector_env`. Spaces, autoreset, infos and seeds are as Gymnasium has them: environment k is
    seeded with `seed + k`, and plays what a single one seeded so plays.

    Args:
        fleet: The environments.
        autoreset: When an environment begins anew after an episode's end.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_vector_v0"}

    def __init__(self, fleet: Fleet, autoreset: AutoresetMode) -> None:
        self._fleet = fleet
        self._begun = False
        self._ahead = [_Ahead(SingleAgentEnv(env), autoreset) for env in fleet.envs]
        super().__init__([functools.partial(_itself, env) for env in self._ahead], autoreset_mode=autoreset)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment, or with `options={"reset_mask": (n,) bool}` in some.

        Args:
            seed: Environment k gets `seed + k`; or a list of seeds.
            options: As of a single environment: `{"scene_id": n}`.
        """
        given = self._fleet.seeds(seed)
        mask = (options or {}).get("reset_mask")
        own = {key: value for key, value in (options or {}).items() if key != "reset_mask"} or None
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        if chosen.shape != (self.num_envs,):
            raise OptionError(f"there are {self.num_envs} environments, but reset_mask has shape {chosen.shape}")
        tasks = zip(self._ahead, given, chosen, strict=True)
        # Should anything fail, episodes are left where they are: then all have to begin anew.
        begun, self._begun = self._begun or bool(chosen.all()), False
        self._fleet.together([functools.partial(env.reset_ahead, one, own) for env, one, now in tasks if now])
        self._begun = begun
        return super().reset(seed=given, options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Act in every environment for one control period, or until its action scheme asks again.

        Args:
            actions: (n, ...) one for each environment.

        Raises:
            ResetNeededError: There was no reset, or something failed since.
        """
        if not self._begun:
            raise ResetNeededError("no episodes are running; call reset() before step()")
        each = list(zip(self._ahead, iterate(self.action_space, actions), strict=True))
        self._begun = False
        self._fleet.together([functools.partial(env.step_ahead, action) for env, action in each])
        self._begun = True
        return super().step(actions)

    def close_extras(self, **kwargs: Any) -> None:
        """Free all simulations."""
        self._fleet.close()


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
    **options: Unpack[EnvOptions],
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
    **options: Unpack[EnvOptions],
) -> ParallelVectorEnv: ...


@shows(HandoverEnv, defaults={"physics": MUJOCO})
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
    **options: Unpack[EnvOptions],
) -> HandoverVectorEnv | ParallelVectorEnv:
    """Many environments in one process, in MuJoCo's physics simulated at once on several threads.

    What an environment plays depends neither on how many others there are nor on the threads, and is what a single
    one plays with the same seed.

    Args:
        num_envs: How many environments.
        agent: The live one, "receiver" or "giver", for a Gymnasium VectorEnv; None for a batch of both agents.
        partner: The other one's policy; default: "replay" for a giver, "yang2021" for a receiver.
        features: Name of the features that the agent sees in place of observations, or one for each agent.
        schemes: Name of the action scheme that takes its outputs in place of actions, or one for each agent.
        autoreset: "next_step", "same_step" or "disabled": when an environment begins anew, as in Gymnasium.
        threads: Threads that simulate; default: one for each core.
        trust: Whether code in a policy file may run.
        options: As `HandoverEnv`, but for `physics`, which is "mujoco" unless said otherwise.

    Raises:
        UnknownNameError: No such agent, policy, features, scheme or autoreset.
        OptionError: A number is not one, or MuJoCo is not installed.
    """
    if autoreset not in AUTORESETS:
        raise UnknownNameError("autoreset", autoreset, AUTORESETS)
    mode = AutoresetMode[autoreset.upper()]
    options.setdefault("physics", MUJOCO)
    fleet = Fleet(num_envs, agent, partner, features, schemes, threads, trust, **options)
    return ParallelVectorEnv(fleet, mode) if agent is None else HandoverVectorEnv(fleet, mode)


def _itself(env: _Ahead) -> _Ahead:
    return env
