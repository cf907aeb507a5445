"""Environments that are stepped together."""

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import TypeVar

import numpy as np
from typing_extensions import Unpack

from handover_marl.envs.constructors import EnvOptions, parallel_env
from handover_marl.envs.encode import encode
from handover_marl.envs.freeze import freeze
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrapper import ParallelWrapper
from handover_marl.errors import OptionError
from handover_marl.options import available_cores
from handover_marl.policies.reference import PolicyLike

_Result = TypeVar("_Result")


class Fleet:
    """Equal environments whose episodes are played together.

    Args:
        num_envs: How many.
        agent: The live one, "receiver" or "giver"; None for both.
        partner: With one live agent the other one's policy; default: "replay" or "yang2021".
        features: Name of the features that each agent sees, by agent or for the live one; None for observations.
        schemes: Likewise of its action scheme; None for actions.
        threads: Threads that simulate; default: one for each core.
        trust: Whether code in a policy file may run.
        options: As `HandoverEnv`.

    Attributes:
        envs: The environments.

    Raises:
        OptionError: A number is not one, or a partner is named though both agents are live.
    """

    def __init__(
        self,
        num_envs: int,
        agent: str | None,
        partner: PolicyLike | None,
        features: str | Mapping[str, str] | None,
        schemes: str | Mapping[str, str] | None,
        threads: int | None,
        trust: bool,
        **options: Unpack[EnvOptions],
    ) -> None:
        count = _whole("num_envs", num_envs)
        threads = _whole("threads", available_cores() if threads is None else threads)
        if agent is None and partner is not None:
            raise OptionError("with both agents live there is no partner; leave out partner, or name the live agent")

        def make() -> HandoverEnv | ParallelWrapper:
            env: HandoverEnv | ParallelWrapper = parallel_env(**options)
            if agent is not None:
                env = freeze(env, agent, partner, trust=trust)
            return env if features is None and schemes is None else encode(env, features, schemes)

        self.envs = [make() for _ in range(count)]
        if find_spec("greenlet") is None:
            raise OptionError("many environments in one process need greenlet: pip install 'handover-marl[mujoco]'")
        # Only now, for the sake of this message.
        from handover_marl.episode.ensemble import Ensemble

        first = world_of(self.envs[0])
        if first.render_mode == "human":
            raise OptionError('render_mode="human" shows one environment; use "rgb_array", or a single environment')
        self._ensemble = Ensemble(options.get("physics", "exact"), first.config, count, threads)
        for number, env in enumerate(self.envs):
            world_of(env).join(self._ensemble, number)

    def seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """One for each environment.

        Args:
            seed: Environment k gets `seed + k`; or a list; None leaves all as they are.

        Raises:
            OptionError: There are more or fewer than environments.
        """
        count = len(self.envs)
        if seed is None:
            return [None] * count
        given: list[int | None] = []
        if isinstance(seed, (int, np.integer)):
            given += [int(seed) + k for k in range(count)]
        else:
            given += seed
        if len(given) != count:
            raise OptionError(f"there are {count} environments and {len(given)} seeds")
        return given

    def together(self, tasks: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Run tasks, each of which resets or steps one of the environments; what they return."""
        return self._ensemble.together(tasks)

    def close(self) -> None:
        """Free all simulations."""
        for env in self.envs:
            env.close()
        self._ensemble.close()


def world_of(env: HandoverEnv | ParallelWrapper) -> HandoverEnv:
    """The two-agent environment at the bottom."""
    return env.world if isinstance(env, ParallelWrapper) else env


def _whole(what: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise OptionError(f"{what}={value!r} must be a whole number, 1 or more")
    return int(value)
