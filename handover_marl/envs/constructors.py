"""The customary constructors."""

import os
from collections.abc import Iterable

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec
from pettingzoo.utils.wrappers import OrderEnforcingWrapper
from typing_extensions import TypedDict, Unpack

from handover_marl.config import CameraConfig, WorldConfig
from handover_marl.envs.arguments import GIVER, RECEIVER
from handover_marl.envs.freeze import FrozenPartnerEnv, freeze
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.rewards import RewardConfig
from handover_marl.envs.wrapper import SingleAgentEnv
from handover_marl.episode.observations import ALL
from handover_marl.models.panda import PANDA
from handover_marl.options import shows
from handover_marl.policies.reference import PolicyLike
from handover_marl.sim.camera.imperfections import CameraImperfections


class EnvOptions(TypedDict, total=False):
    """The options of `HandoverEnv`, which says what they mean."""

    setup: str
    split: str
    data_dir: str | os.PathLike[str] | None
    dataset: str
    physics: str
    control_period: float
    render_mode: str | None
    camera: CameraConfig | None
    rewards: str | RewardConfig
    scenes: Iterable[int] | None
    max_cycles: int | None
    config: WorldConfig
    robot: str
    sight: str | None
    observe: str
    renderer: str
    geometry: str
    imperfections: str | CameraImperfections | None


@shows(HandoverEnv)
def parallel_env(**options: Unpack[EnvOptions]) -> HandoverEnv:
    """The environment with both agents acting at once; options as `HandoverEnv`."""
    return HandoverEnv(**options)


@shows(HandoverEnv)
def env(**options: Unpack[EnvOptions]) -> AECEnv:
    """The environment with the agents acting one after the other, giver first; options as `HandoverEnv`."""
    return OrderEnforcingWrapper(parallel_to_aec(parallel_env(**options)))


@shows(HandoverEnv)
def receiver_env(partner: PolicyLike = "replay", trust: bool = False, **options: Unpack[EnvOptions]) -> SingleAgentEnv:
    """A Gymnasium environment of the robot alone, the giver frozen to a policy; options as `HandoverEnv`."""
    return freeze(HandoverEnv(**options), RECEIVER, partner, api="gymnasium", trust=trust)


@shows(HandoverEnv)
def giver_env(partner: PolicyLike = "yang2021", trust: bool = False, **options: Unpack[EnvOptions]) -> SingleAgentEnv:
    """A Gymnasium environment of the person alone, the receiver frozen to a policy; options as `HandoverEnv`."""
    return freeze(HandoverEnv(**options), GIVER, partner, api="gymnasium", trust=trust)


def benchmark_env(
    setup: str = "s0",
    split: str = "test",
    data_dir: str | os.PathLike[str] | None = None,
    dataset: str = "auto",
    control_period: float = 0.1,
    render_mode: str | None = None,
    robot: str = PANDA,
    sight: str | None = None,
    observe: str = ALL,
) -> FrozenPartnerEnv:
    """The official task for one receiver. Giver, physics, rules, horizon and camera are the benchmark's."""
    world = HandoverEnv(
        setup=setup,
        split=split,
        data_dir=data_dir,
        dataset=dataset,
        physics="exact",
        control_period=control_period,
        render_mode=render_mode,
        robot=robot,
        sight=sight,
        observe=observe,
    )
    return freeze(world, RECEIVER, "replay")
