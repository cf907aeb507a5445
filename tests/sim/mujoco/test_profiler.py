"""MuJoCo's own profiler, which is off where its physics are used."""

import subprocess
import sys
from collections.abc import Iterator

import pytest

mujoco = pytest.importorskip("mujoco")

from handover_marl.sim.mujoco.profiler import stop_profiler  # noqa: E402

BALL = "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"


def profiled() -> bool:
    """Whether the engine times what it does."""
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    for _ in range(100):
        mujoco.mj_step(model, data)
    return bool(data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration > 0.0)


@pytest.fixture(autouse=True)
def as_it_was() -> Iterator[None]:
    yield
    mujoco.set_mjcb_time(None)
    stop_profiler()


def test_the_profiler_runs_until_it_is_stopped_and_can_be_started_again() -> None:
    mujoco.set_mjcb_time(None)
    assert profiled()
    assert stop_profiler()
    assert not profiled()
    mujoco.set_mjcb_time(None)
    assert profiled()


def test_a_clock_of_ones_own_is_left_alone() -> None:
    ticks = iter(range(10**9))
    mujoco.set_mjcb_time(lambda: float(next(ticks)))
    assert not stop_profiler()
    assert profiled()


def test_it_does_not_run_where_worlds_are_simulated() -> None:
    code = "import handover_marl.sim.mujoco.lanes, tests.sim.mujoco.test_profiler as test; print(test.profiled())"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False"]
