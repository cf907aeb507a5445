"""PettingZoo's two customary constructors."""

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from handover_marl.handover_env import HandoverEnv


def parallel_env(**options: Any) -> HandoverEnv:
    """The environment with both agents acting at once; options as `HandoverEnv`."""
    return HandoverEnv(**options)


def env(**options: Any) -> AECEnv:
    """The environment with the agents acting one after the other, giver first; options as `HandoverEnv`."""
    return OrderEnforcingWrapper(parallel_to_aec(parallel_env(**options)))
