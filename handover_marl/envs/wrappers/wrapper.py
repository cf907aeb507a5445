"""Base class of the environment's wrappers, and a Gymnasium adapter for one agent."""

import copy
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

import gymnasium
import numpy.typing as npt
from gymnasium.utils import EzPickle
from pettingzoo.utils.wrappers import BaseParallelWrapper

from handover_marl.envs.handover_env import HandoverEnv, check_seed
from handover_marl.errors import OptionError, check_name
from handover_marl.simulation.camera.optics import CameraInfo

#: Prefix of the key of a reward term in infos.
REWARD_PREFIX = "reward/"
ByAgent = dict[str, Any]  # values by agent, "giver" and "receiver"
Array = npt.NDArray[Any]
#: The environment, or any PettingZoo wrapper of it.
WrappableEnv: TypeAlias = HandoverEnv | BaseParallelWrapper
ParallelStep = tuple[ByAgent, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, float]]]


class ParallelWrapper(BaseParallelWrapper, EzPickle):  # type: ignore[misc]
    """Base class of wrappers of the parallel environment.

    Subclasses override some methods; the wrapped environment provides all other attributes and methods.

    Args:
        env: A `HandoverEnv`, or any `pettingzoo.utils.BaseParallelWrapper` of one.
        agents: Agents that the wrapper has; default: all agents of `env`.
    """

    metadata: dict[str, Any] = dict(HandoverEnv.metadata)
    __copy__ = copy.deepcopy  # a copy has a simulation of its own

    def __init__(self, env: WrappableEnv, agents: Sequence[str] | None = None) -> None:
        check_env(env)
        super().__init__(env)
        self.possible_agents: list[str] = list(env.possible_agents if agents is None else agents)
        base = self.unwrapped
        self.render_mode: str | None = base.render_mode
        self.metadata = {**self.metadata, "render_fps": base.metadata["render_fps"]}

    @property
    def unwrapped(self) -> HandoverEnv:
        """Innermost environment, which has two agents and no wrapper."""
        env: HandoverEnv = self.env.unwrapped
        return env

    @property
    def agents(self) -> list[str]:
        """Names of the agents of the running episode; empty if no episode is running."""
        return [agent for agent in self.env.agents if agent in self.possible_agents]


def check_env(env: object) -> None:
    """Raise `OptionError` unless a value is a `HandoverEnv` or a PettingZoo wrapper of one."""
    base = env.unwrapped if isinstance(env, BaseParallelWrapper) else env
    if not isinstance(base, HandoverEnv):
        raise OptionError(
            "env must be made by handover_marl.parallel_env() or a pettingzoo.utils.BaseParallelWrapper of it, got "
            f"{env!r}"
        )


def list_wrappers(env: WrappableEnv) -> list[Any]:
    """Return the wrappers of an environment, the outermost first; [] for a `HandoverEnv`."""
    wrappers = []
    while isinstance(env, BaseParallelWrapper):
        wrappers.append(env)
        env = env.env
    return wrappers


class SingleAgentEnv(gymnasium.Env[Any, Any], EzPickle):
    """Gymnasium adapter of a parallel environment with one agent, as Stable-Baselines3 needs it.

    Args:
        env: Parallel environment with one agent, as `control_agent` and `encode` return it.

    Attributes:
        scene_ids: Numbers of the scenes that `reset` draws from.
    """

    metadata: dict[str, Any] = dict(HandoverEnv.metadata)
    __copy__ = copy.deepcopy  # a copy has a simulation of its own

    def __init__(self, env: ParallelWrapper) -> None:
        EzPickle.__init__(self, env)
        if len(env.possible_agents) != 1:
            raise OptionError(
                f"a Gymnasium environment must have one agent, got {' and '.join(env.possible_agents)}; call "
                "control_agent() first"
            )
        self.env, self.scene_ids = env, env.unwrapped.scene_ids
        (self.agent,) = env.possible_agents
        self.observation_space = env.observation_space(self.agent)
        self.action_space = env.action_space(self.agent)
        self.render_mode, self.metadata = env.render_mode, env.metadata

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return observation and info. `options={"scene_id": n}` chooses the scene."""
        super().reset(seed=None if seed is None else check_seed(seed))
        observations, infos = self.env.reset(seed, options)
        return observations[self.agent], infos[self.agent]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step for one control period, or until an action scheme needs outputs; result as in `gymnasium.Env.step`."""
        observations, rewards, terminations, truncations, infos = self.env.step({self.agent: action})
        agent = self.agent
        return observations[agent], rewards[agent], terminations[agent], truncations[agent], infos[agent]

    def camera_info(self) -> dict[str, CameraInfo]:
        """Return size, intrinsics and pose of each camera by name, as `HandoverEnv.camera_info`."""
        return self.env.unwrapped.camera_info()

    def render(self) -> Any:
        """Return an RGB image (height, width, 3) in the mode "rgb_array", else None."""
        return self.env.render()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()


Api = Literal["parallel", "gymnasium"]


def convert_api(env: ParallelWrapper, api: Api) -> ParallelWrapper | SingleAgentEnv:
    """Return the parallel environment unchanged, or for the API "gymnasium" a `SingleAgentEnv` of it."""
    check_name("api", api, ("parallel", "gymnasium"))
    return env if api == "parallel" else SingleAgentEnv(env)
