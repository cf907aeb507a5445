"""Constructors of the handover environment for the APIs of PettingZoo and Gymnasium."""

import dataclasses
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from handover_marl.envs.arguments import GIVER, RECEIVER
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.freeze import FrozenPartnerEnv, freeze
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.errors import OptionError
from handover_marl.execution.options import forward_signature
from handover_marl.policies.reference import PolicyLike

# Fields that the benchmark does not fix; it prescribes physics, rules, horizon and camera.
_BENCHMARK_FIELDS = {"setup", "split", "data_dir", "dataset", "control_period", "render_mode", "robot", "obs_mode"}
_PRESCRIBED = tuple(field.name for field in dataclasses.fields(EnvConfig) if field.name not in _BENCHMARK_FIELDS)


@forward_signature(EnvConfig)
def parallel_env(config: EnvConfig | None = None, **fields: Any) -> HandoverEnv:
    """Make a PettingZoo parallel environment, in which both agents act at the same time.

    Args:
        config: Configuration; default: one made of `fields`.
        fields: Fields of `handover_marl.envs.config.EnvConfig`, in place of `config`.
    """
    return HandoverEnv(config, **fields)


@forward_signature(EnvConfig)
def env(config: EnvConfig | None = None, **fields: Any) -> AECEnv:
    """Make a PettingZoo AEC environment, in which the agents act in turn, the giver first.

    Args:
        config: Configuration; default: one made of `fields`.
        fields: Fields of `handover_marl.envs.config.EnvConfig`, in place of `config`.
    """
    return OrderEnforcingWrapper(parallel_to_aec(parallel_env(config, **fields)))


@forward_signature(EnvConfig)
def receiver_env(
    partner: PolicyLike = "replay", trust: bool = False, config: EnvConfig | None = None, **fields: Any
) -> SingleAgentEnv:
    """Make a Gymnasium environment of the robot, in which a fixed policy acts for the giver.

    Args:
        partner: Policy of the giver, the agent that is not controlled from outside.
        trust: Whether a policy file may run code.
        config: Configuration; default: one made of `fields`.
        fields: Fields of `handover_marl.envs.config.EnvConfig`, in place of `config`.
    """
    return freeze(HandoverEnv(config, **fields), RECEIVER, partner, api="gymnasium", trust=trust)


@forward_signature(EnvConfig)
def giver_env(
    partner: PolicyLike = "yang2021", trust: bool = False, config: EnvConfig | None = None, **fields: Any
) -> SingleAgentEnv:
    """Make a Gymnasium environment of the person, in which a fixed policy acts for the receiver.

    Args:
        partner: Policy of the receiver, the agent that is not controlled from outside.
        trust: Whether a policy file may run code.
        config: Configuration; default: one made of `fields`.
        fields: Fields of `handover_marl.envs.config.EnvConfig`, in place of `config`.
    """
    return freeze(HandoverEnv(config, **fields), GIVER, partner, api="gymnasium", trust=trust)


@forward_signature(EnvConfig, without=_PRESCRIBED, defaults={"split": "test"})
def benchmark_env(**fields: Any) -> FrozenPartnerEnv:
    """Make the official benchmark task of a receiver: exact physics, official rules, replayed giver.

    Args:
        fields: Fields of `handover_marl.envs.config.EnvConfig` that the benchmark does not fix.

    Raises:
        OptionError: A field is prescribed by the benchmark.
    """
    fixed = [name for name in fields if name in _PRESCRIBED]
    if fixed:
        raise OptionError(f"benchmark_env() prescribes {', '.join(fixed)}; use parallel_env() and freeze()")
    return freeze(HandoverEnv(**{"split": "test", **fields}), RECEIVER, "replay")
