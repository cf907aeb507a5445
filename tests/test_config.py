import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.config import (
    OFFICIAL_CONFIG,
    CameraConfig,
    CheckedConfig,
    GiverConfig,
    HandConfig,
    MotorConfig,
    PandaConfig,
    PhysicsConfig,
    ProtocolConfig,
    WorldConfig,
)
from handover_marl.errors import OptionError
from handover_marl.simulation.camera.noise import CameraNoise

MADE: tuple[CheckedConfig, ...] = (
    OFFICIAL_CONFIG,
    OFFICIAL_CONFIG.physics,
    OFFICIAL_CONFIG.physics.panda,
    OFFICIAL_CONFIG.physics.objects,
    OFFICIAL_CONFIG.physics.hand,
    OFFICIAL_CONFIG.physics.panda.motor,
    OFFICIAL_CONFIG.protocol,
    OFFICIAL_CONFIG.giver,
    CameraConfig(),
    CameraNoise(),
)
FIELDS = [(config, part.name) for config in MADE for part in fields(config)]  # type: ignore[arg-type]
WRONG = (
    None,
    "13",
    "down",
    math.nan,
    math.inf,
    -math.inf,
    {},
    (),
    (math.nan,) * 9,
    True,
    -(10**400),
    1j,
    "ab",
    b"abc",
    WorldConfig,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "name"), FIELDS, ids=lambda part: part if isinstance(part, str) else type(part).__name__
)
@pytest.mark.parametrize("value", WRONG, ids=lambda value: repr(value)[:20])
def test_wrong_values_are_refused_with_the_name_of_the_field(config: CheckedConfig, name: str, value: Any) -> None:
    values = {part.name: getattr(config, part.name) for part in fields(config)} | {name: value}  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=name):
        type(config)(**values)


@pytest.mark.parametrize(
    "make",
    [
        lambda: MotorConfig(force=-1.0, position_gain=0.1),
        lambda: PandaConfig(base_orientation=(0.0, 0.0, 0.0, 0.0)),
        lambda: PandaConfig(start_joints=(0.0, 0.0, 0.0)),
        lambda: HandConfig(restitution=1.5),
        lambda: GiverConfig(displacement=-1.0),
        lambda: GiverConfig(preview=(-1.0, 0.2, 0.3, 0.4, 0.5)),
        lambda: GiverConfig(preview=(0.1, 0.2)),
        lambda: ProtocolConfig(goal_center=(0.0, 0.0)),  # type: ignore[arg-type]
        lambda: ProtocolConfig(goal_radius=-0.1),
        lambda: ProtocolConfig(release_steps=0),
        lambda: ProtocolConfig(horizon_steps=13.0),  # type: ignore[arg-type]
        lambda: ProtocolConfig(region_lower=(1.0, 1.0, 1.0)),
        lambda: WorldConfig(initial_joint_noise=-0.1),
        lambda: WorldConfig(initial_joint_noise=0.31),
        lambda: CameraConfig(width=0),
        lambda: CameraConfig(vertical_fov=180.0),
        lambda: CameraConfig(near=1.0, far=0.5),
        lambda: CameraConfig(position=(1.0, 1.0, 1.0), target=(1.0, 1.0, 1.0)),
    ],
)
def test_values_out_of_range_are_refused(make: Callable[[], CheckedConfig]) -> None:
    with pytest.raises(OptionError):
        make()


@given(st.floats(-100.0, 100.0), st.integers(1, 10**6))
def test_values_in_range_are_kept(gravity: float, steps: int) -> None:
    assert PhysicsConfig(gravity=gravity).gravity == gravity
    assert ProtocolConfig(horizon_steps=steps).horizon_steps == steps


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
