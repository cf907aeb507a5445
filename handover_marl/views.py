"""One live agent: the other one is frozen to a policy.

`FrozenPartnerEnv` is a PettingZoo ParallelEnv with a single agent, `SingleAgentEnv` a Gymnasium environment of it.
`benchmark_env` is the official task: the giver frozen to replay, exact physics, 13 s.
"""

import os
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle
from pettingzoo import ParallelEnv

from handover_marl import givers, receivers
from handover_marl.errors import UnknownNameError
from handover_marl.handover_env import AGENTS, GIVER, RECEIVER, HandoverEnv, StepResult
from handover_marl.observations import Observation
from handover_marl.policy_clock import PolicyClock

DEFAULT_PARTNERS = {RECEIVER: "replay", GIVER: "yang2021"}


class FrozenPartnerEnv(ParallelEnv, EzPickle):  # type: ignore[misc]
    """`HandoverEnv` with one live agent.

    Args:
        agent: The live one, "receiver" or "giver".
        partner: Name of the other one's policy; default: "replay" for a giver, "yang2021" for a receiver.
        options: As `HandoverEnv`.

    Raises:
        UnknownNameError: No such agent or policy.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_frozen_partner_v0"}

    def __init__(self, agent: str = RECEIVER, partner: str | None = None, **options: Any) -> None:
        EzPickle.__init__(self, agent, partner, **options)
        if agent not in AGENTS:
            raise UnknownNameError("agent", agent, AGENTS)
        self.live_agent = agent
        self.partner_agent = GIVER if agent == RECEIVER else RECEIVER
        self.env = HandoverEnv(**options)
        name = DEFAULT_PARTNERS[agent] if partner is None else partner
        self._partner = PolicyClock(
            givers.make(name) if agent == RECEIVER else receivers.make(name, self.env.dataset)
        )
        self._partner_observation: Observation = {}
        self.possible_agents = [agent]
        self.render_mode = self.env.render_mode
        self.metadata = {**self.metadata, "render_fps": self.env.metadata["render_fps"]}
        self.scene_ids = self.env.scene_ids
        self.state_space = self.env.state_space

    @property
    def agents(self) -> list[str]:
        """The live agent while an episode runs."""
        return [agent for agent in self.env.agents if agent == self.live_agent]

    def observation_space(self, agent: str) -> spaces.Dict:
        """The live agent's observation space."""
        return self.env.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Box:
        """The live agent's action space."""
        return self.env.action_space(agent)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """As `HandoverEnv.reset`, for the live agent."""
        observations, infos = self.env.reset(seed, options)
        self._partner.reset(seed)
        self._partner_observation = observations[self.partner_agent]
        return self._mine(observations), self._mine(infos)

    def step(self, actions: dict[str, Any]) -> StepResult:
        """As `HandoverEnv.step`, for the live agent; the partner acts on what it saw last."""
        partner_action = self._partner.act(self._partner_observation) if self.env.agents else None
        observations, rewards, ended, timed_out, infos = self.env.step(
            {self.live_agent: actions.get(self.live_agent), self.partner_agent: partner_action}
        )
        self._partner_observation = observations[self.partner_agent]
        mine = self._mine
        return mine(observations), mine(rewards), mine(ended), mine(timed_out), mine(infos)

    def state(self) -> npt.NDArray[np.float32]:
        """As `HandoverEnv.state`."""
        return self.env.state()

    def render(self) -> npt.NDArray[np.uint8] | None:
        """As `HandoverEnv.render`."""
        return self.env.render()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _mine(self, by_agent: dict[str, Any]) -> dict[str, Any]:
        return {self.live_agent: by_agent[self.live_agent]}


def _without_none(info: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in info.items() if value is not None}


class SingleAgentEnv(gymnasium.Env[Any, Any], EzPickle):
    """A Gymnasium environment of one agent, for libraries such as Stable-Baselines3.

    `info` has `release_step` and `release` only once there is one: Gymnasium's vector environments make arrays of
    infos and cannot take None.

    Args:
        agent: The live one, "receiver" or "giver".
        partner: Name of the other one's policy.
        options: As `HandoverEnv`.
    """

    metadata: dict[str, Any] = dict(HandoverEnv.metadata)

    def __init__(self, agent: str = RECEIVER, partner: str | None = None, **options: Any) -> None:
        EzPickle.__init__(self, agent, partner, **options)
        self.view = FrozenPartnerEnv(agent, partner, **options)
        self.agent = agent
        self.observation_space = self.view.observation_space(agent)
        self.action_space = self.view.action_space(agent)
        self.render_mode = self.view.render_mode
        self.metadata = {**self.metadata, "render_fps": self.view.metadata["render_fps"]}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; `options={"scene_id": n}` chooses the scene."""
        super().reset(seed=seed)
        observations, infos = self.view.reset(seed, options)
        return observations[self.agent], _without_none(infos[self.agent])

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one control period."""
        observations, rewards, ended, timed_out, infos = self.view.step({self.agent: action})
        agent = self.agent
        info = _without_none(infos[agent])
        return observations[agent], rewards[agent], ended[agent], timed_out[agent], info

    def render(self) -> Any:
        """As `HandoverEnv.render`."""
        return self.view.render()

    def close(self) -> None:
        """Free the simulation."""
        self.view.close()


def benchmark_env(
    setup: str = "s0",
    split: str = "test",
    data_dir: str | os.PathLike[str] | None = None,
    dataset: str = "auto",
    control_period: float = 0.1,
    render_mode: str | None = None,
) -> FrozenPartnerEnv:
    """The official task for one receiver. Giver, physics and horizon are the benchmark's and cannot be chosen."""
    return FrozenPartnerEnv(
        RECEIVER,
        "replay",
        setup=setup,
        split=split,
        data_dir=data_dir,
        dataset=dataset,
        physics="exact",
        control_period=control_period,
        render_mode=render_mode,
    )
