"""Tests of stopping MuJoCo's profiler when a world is created."""

import subprocess
import sys

import pytest

mujoco = pytest.importorskip("mujoco")


BALL = "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"


def is_profiled() -> bool:
    """Return whether MuJoCo measures the time of steps."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    for _ in range(100):
        mujoco.mj_step(model, data)
    return bool(data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0.0)


def test_making_a_world_stops_the_profiler_and_importing_does_not() -> None:
    code = """
from handover_marl.config import PhysicsConfig
from handover_marl.simulation.mujoco.world import MujocoWorld
from tests.simulation.mujoco.test_engine import is_profiled
imported = is_profiled()
MujocoWorld(PhysicsConfig())
print(imported, is_profiled())
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["True", "False"]
