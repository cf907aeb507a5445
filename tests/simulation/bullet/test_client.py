"""Tests of PyBullet's client and window: missing screens, second windows, closed outputs and damaged files."""

import os
import subprocess
import sys

import pybullet
import pytest

from handover_marl.errors import SimulationError
from handover_marl.simulation.bullet import client as client_module
from handover_marl.simulation.bullet.client import connect


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X11 is Linux's way to a screen")
def test_missing_x_server_is_an_error_also_without_stderr() -> None:
    code = (
        "import os, sys; os.close(2); sys.stderr = None\n"
        "from handover_marl.errors import SimulationError\n"
        "from handover_marl.simulation.bullet.client import connect\n"
        "connect()\n"
        "try:\n    connect(window=True)\n"
        "except SimulationError as error:\n    print('error:', error)\n"
    )
    env = {**os.environ, "DISPLAY": ":77"}
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True, env=env)
    assert "error:" in done.stdout
    assert "xvfb-run" in done.stdout
    assert "rgb_array" in done.stdout


def test_second_window_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(mode: int) -> int:
        raise pybullet.error("Only one local in-process GUI/GUI_SERVER connection allowed.")

    monkeypatch.setattr(client_module, "_require_screen", lambda: None)
    monkeypatch.setattr(pybullet, "connect", refuse)
    with pytest.raises(SimulationError, match="close the other environment"):
        connect(window=True)


def test_close_after_the_server_has_gone() -> None:
    client = connect()
    client.disconnect()
    client.close()
    client.close()
