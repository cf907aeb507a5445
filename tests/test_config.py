import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from handover_marl.config import (
    OFFICIAL_CONFIG,
    CameraConfig,
    CheckedConfig,
    GiverConfig,
    MotorConfig,
    PandaConfig,
    ProtocolConfig,
    WorldConfig,
)
from handover_marl.errors import OptionError
from handover_marl.simulation.camera.noise import CameraNoise

PHYSICS = OFFICIAL_CONFIG.physics
CONFIGS: tuple[CheckedConfig, ...] = (
    *(OFFICIAL_CONFIG, OFFICIAL_CONFIG.protocol, OFFICIAL_CONFIG.giver, CameraConfig(), CameraNoise()),
    *(PHYSICS, PHYSICS.panda, PHYSICS.panda.motor, PHYSICS.objects, PHYSICS.hand),
)


@pytest.mark.parametrize("value", [None, "13", math.nan, -math.inf, (), (math.nan,) * 9, True, b"a", dict])
def test_wrong_values_are_refused_with_the_name_of_the_field(value: Any) -> None:
    for config in CONFIGS:
        values: dict[str, Any] = {part.name: getattr(config, part.name) for part in fields(config)}  # type: ignore[arg-type]
        for name in values:
            with pytest.raises(OptionError, match=name):
                type(config)(**values | {name: value})


@pytest.mark.parametrize(
    ("make", "value"),
    [
        (lambda value: MotorConfig(force=value, position_gain=0.1), 0.0),
        (lambda value: MotorConfig(force=1.0, position_gain=value), 1.01),
        (lambda value: MotorConfig(1.0, 0.1, velocity_gain=value), 1.01),
        (lambda value: PandaConfig(base_orientation=value), (0.0, 0.0, 0.0, 0.0)),
        (lambda value: GiverConfig(preview=value), (-1.0, 0.2, 0.3, 0.4, 0.5)),
        (lambda value: GiverConfig(preview=value), (0.1, 0.2, 0.3, 0.4, 0.5005)),
        (lambda value: GiverConfig(opening_time=value), 0.0),
        (lambda value: CameraNoise(latency=value), 0.0333),
        (lambda value: CameraConfig(period=value), 1.0 / 30.0),
        (lambda value: ProtocolConfig(release_steps=value), 0),
        (lambda value: ProtocolConfig(region_lower=value), (1.0, 1.0, 1.0)),
        (lambda value: WorldConfig(initial_joint_noise=value), 0.31),
        (lambda value: CameraConfig(near=value, far=0.5), 1.0),
        (lambda value: CameraConfig(position=value, target=value), (1.0, 1.0, 1.0)),
    ],
)
def test_values_out_of_range_are_refused(make: Callable[[Any], CheckedConfig], value: object) -> None:
    with pytest.raises(OptionError):
        make(value)


def test_lists_and_arrays_become_tuples() -> None:
    expected = ProtocolConfig(goal_center=(0.5, 0.25, 1.0))
    assert ProtocolConfig(goal_center=[0.5, 0.25, 1.0]) == expected  # type: ignore[arg-type]
    assert hash(ProtocolConfig(goal_center=np.array([0.5, 0.25, 1.0]))) == hash(expected)  # type: ignore[arg-type]


def test_initial_joints_are_drawn_within_the_noise() -> None:
    config = WorldConfig(initial_joint_noise=0.2)
    start = np.array(PandaConfig().start_joints)
    drawn = np.array([config.draw_initial_joints(seed) for seed in range(200)]) - start
    assert np.abs(drawn[:, :7]).max() <= 0.2
    assert (drawn[:, :7].max(axis=0) > 0.15).all()
    assert (drawn[:, :7].min(axis=0) < -0.15).all()
    assert not drawn[:, 7:].any(), "the gripper starts open"
    assert config.draw_initial_joints(3) == config.draw_initial_joints(3) != config.draw_initial_joints(4)
    assert WorldConfig().draw_initial_joints(3) == PandaConfig().start_joints
