"""Single environments that are stepped one after another, for configurations without arrays."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from handover_marl.envs.vector.batch import EnvResult
from handover_marl.envs.wrappers.wrapper import ByAgent, WrappableEnv, check_env
from handover_marl.errors import HandoverError, OptionError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, Indices

#: Function or class that wraps the environment by a `pettingzoo.utils.BaseParallelWrapper`.
WrapperFunction: TypeAlias = Callable[[WrappableEnv], WrappableEnv]


class SingleEnvs:
    """Environments of one configuration, each simulated on its own; see `batch.Envs`.

    Args:
        make: Function that makes an environment.
        count: Number of environments.

    Attributes:
        envs: The environments.
    """

    arrays = NUMPY_ARRAYS

    def __init__(self, make: Callable[[], WrappableEnv], count: int) -> None:
        self.envs = [make() for _ in range(count)]

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes in the environments `rows` (r,), with a seed for each; see `batch.Envs.reset`."""
        own_options = None if options is None else dict(options)
        starts = [
            self.envs[row].reset(seed=seed, options=own_options) for row, seed in zip(rows.tolist(), seeds, strict=True)
        ]
        observations, infos = zip(*starts, strict=True)
        agents, count = list(observations[0]), len(rows)
        flags = {agent: np.zeros(count, dtype=bool) for agent in agents}
        rewards = {agent: np.zeros(count) for agent in agents}
        return EnvResult(self._stack(observations), rewards, flags, flags, _stack_infos(infos))

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Step the environments `rows` (r,) with actions (r, ...) by agent; see `batch.Envs.step`."""
        steps = [
            self.envs[row].step({agent: values[number] for agent, values in actions.items()})
            for number, row in enumerate(rows.tolist())
        ]
        observations, *scalars, infos = zip(*steps, strict=True)
        rewards, terminated, truncated = (
            {agent: np.array([by_agent[agent] for by_agent in column]) for agent in column[0]} for column in scalars
        )
        return EnvResult(self._stack(observations), rewards, terminated, truncated, _stack_infos(infos))

    def render(self) -> list[Any] | None:
        """Return the RGB image (height, width, 3) of each environment; None unless `render_mode` is "rgb_array"."""
        return [env.render() for env in self.envs] if self.envs[0].render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the simulations."""
        for env in self.envs:
            env.close()

    def _stack(self, observations: Sequence[ByAgent]) -> ByAgent:
        stacked = {}
        for agent in observations[0]:
            space = self.envs[0].observation_space(agent)
            buffer: Any = create_empty_array(space, n=len(observations))
            stacked[agent] = concatenate(space, [by_agent[agent] for by_agent in observations], buffer)
        return stacked


def _stack_infos(infos: Sequence[ByAgent]) -> ByAgent:
    return {
        agent: {key: np.array([info[agent][key] for info in infos]) for key in infos[0][agent]} for agent in infos[0]
    }


def apply_wrapper(wrapper: WrapperFunction, env: WrappableEnv) -> WrappableEnv:
    """Return an environment wrapped by a user's function or class `wrapper`.

    Raises:
        OptionError: The wrapper cannot be called, fails, or does not wrap the environment that it gets.
    """
    if not callable(wrapper):
        raise OptionError(f"wrappers must be functions or classes that wrap an environment, got {wrapper!r}")
    try:
        wrapped = wrapper(env)
    except HandoverError:
        raise
    except (Exception, SystemExit) as error:  # code of the user
        raise OptionError(f"wrapper {wrapper!r} failed ({type(error).__name__}: {error})") from error
    check_env(wrapped)
    if wrapped.unwrapped is not env.unwrapped:
        raise OptionError(f"wrappers must wrap the environment that they get, got another one from {wrapper!r}")
    return wrapped
