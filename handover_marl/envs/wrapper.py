"""What wrappers of a parallel environment pass on."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from pettingzoo import ParallelEnv

from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.episode.sight import View
from handover_marl.errors import OptionError

ParallelStep = tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, float]]]


class ParallelWrapper(ParallelEnv, EzPickle):  # type: ignore[misc]
    """A parallel environment around another one; override what differs.

    Args:
        env: A `HandoverEnv`, or a wrapper of one.
        agents: The agents that are left; default: all.
    """

    metadata: dict[str, Any] = dict(HandoverEnv.metadata)

    def __init__(self, env: "HandoverEnv | ParallelWrapper", agents: Sequence[str] | None = None) -> None:
        if not isinstance(env, (HandoverEnv, ParallelWrapper)):
            raise OptionError(
                f"{type(self).__name__} wraps handover_marl.parallel_env(...) or one of its wrappers, not "
                f"{type(env).__name__}"
            )
        self.env: HandoverEnv | ParallelWrapper = env
        self.possible_agents: list[str] = list(env.possible_agents if agents is None else agents)
        self.render_mode: str | None = env.render_mode
        self.metadata = {**self.metadata, "render_fps": env.metadata["render_fps"]}
        self._rng: np.random.Generator | None = None

    @property
    def world(self) -> HandoverEnv:
        """The two-agent environment at the bottom."""
        return self.env.world if isinstance(self.env, ParallelWrapper) else self.env

    @property
    def scene_ids(self) -> tuple[int, ...]:
        """The scenes that are drawn from."""
        return self.world.scene_ids

    @property
    def state_space(self) -> spaces.Box:
        """As `HandoverEnv.state_space`."""
        return self.world.state_space

    @property
    def np_random(self) -> np.random.Generator:
        """What this wrapper draws with."""
        if self._rng is None:
            self._rng, _ = seeding.np_random(None)
        return self._rng

    @property
    def agents(self) -> list[str]:
        """The agents that are left while an episode runs."""
        return [agent for agent in self.env.agents if agent in self.possible_agents]

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The agent's observation space."""
        return self.env.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Box:
        """The agent's action space."""
        return self.env.action_space(agent)

    def state(self) -> npt.NDArray[np.float32]:
        """As `HandoverEnv.state`."""
        return self.world.state()

    def render(self) -> npt.NDArray[np.uint8] | None:
        """As `HandoverEnv.render`."""
        return self.world.render()

    def look(self) -> View:
        """As `HandoverEnv.look`."""
        return self.world.look()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _seed(self, seed: int | None) -> None:
        if seed is not None:
            self._rng, _ = seeding.np_random(seed)


class SingleAgentEnv(gymnasium.Env[Any, Any], EzPickle):
    """A Gymnasium environment of a parallel one that has a single agent, for libraries such as Stable-Baselines3.

    Args:
        env: What `freeze` or `encode` returns, with one agent.

    Raises:
        OptionError: It has more agents.
    """

    metadata: dict[str, Any] = dict(HandoverEnv.metadata)

    def __init__(self, env: ParallelWrapper) -> None:
        EzPickle.__init__(self, env)
        if len(env.possible_agents) != 1:
            raise OptionError(
                f"a Gymnasium environment has one agent, this one has {' and '.join(env.possible_agents)}; freeze "
                "one of them first"
            )
        self.env = env
        (self.agent,) = env.possible_agents
        self.observation_space = env.observation_space(self.agent)
        self.action_space = env.action_space(self.agent)
        self.render_mode, self.metadata = env.render_mode, env.metadata

    @property
    def scene_ids(self) -> tuple[int, ...]:
        """The scenes that are drawn from."""
        return self.env.scene_ids

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; `options={"scene_id": n}` chooses the scene."""
        super().reset(seed=seed)
        observations, infos = self.env.reset(seed, options)
        return observations[self.agent], infos[self.agent]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act for one control period, or until the action scheme asks again."""
        observations, rewards, ended, timed_out, infos = self.env.step({self.agent: action})
        agent = self.agent
        return observations[agent], rewards[agent], ended[agent], timed_out[agent], infos[agent]

    def render(self) -> Any:
        """As `HandoverEnv.render`."""
        return self.env.render()

    def look(self) -> View:
        """As `HandoverEnv.look`."""
        return self.env.look()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()
