"""Constructors of the handover environment for the APIs of PettingZoo and Gymnasium."""

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec

from handover_marl.envs.config import EnvConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.control_agent import control_agent
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike


@forward_signature(EnvConfig)
def parallel_env(**fields: Any) -> HandoverEnv:
    """Make a PettingZoo parallel environment, in which both agents act at the same time.

    Args:
        fields: Fields of `handover_marl.envs.config.EnvConfig`.
    """
    return HandoverEnv(EnvConfig(**fields))


@forward_signature(EnvConfig)
def env(**fields: Any) -> AECEnv:
    """Make a PettingZoo AEC environment, in which the agents act in turn, the giver first.

    Args:
        fields: Fields of `handover_marl.envs.config.EnvConfig`.
    """
    return parallel_to_aec(parallel_env(**fields))


@forward_signature(EnvConfig)
def single_agent_env(
    agent: str, partner: PolicyLike | None = None, trust: bool = False, **fields: Any
) -> SingleAgentEnv:
    """Make a Gymnasium environment of one agent, in which a fixed policy acts for the other agent.

    Args:
        agent: Agent that is controlled from outside, "receiver" for the robot or "giver" for the person.
        partner: Policy of the other agent; default: "replay" for a giver, "yang2021" for a receiver.
        trust: Whether modules that a policy file or a population names may be imported.
        fields: Fields of `handover_marl.envs.config.EnvConfig`.
    """
    controlled: SingleAgentEnv = control_agent(parallel_env(**fields), agent, partner, api="gymnasium", trust=trust)
    return controlled
