"""Tests of PyBullet's client and window: missing screens, second windows, lost connections and viewpoint."""

import ctypes
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pybullet
import pytest

from handover_marl.config import CameraConfig
from handover_marl.errors import SimulationError
from handover_marl.simulation.bullet import client as client_module
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf
from tests.comma_locale import COMMA, install_comma_locale
from tests.geometry.test_unreadable_models import write_model
from tests.unreadable import UNREADABLE, refuses_within, replace_by

on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X11 is Linux's way to a screen")


def needs_screen() -> None:
    try:
        client_module._require_screen()
    except SimulationError as error:
        pytest.skip(str(error))


def run(code: str, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, timeout=120, check=False, env=env
    )


def view_matrix(client: BulletClient) -> npt.NDArray[np.float64]:
    return np.asarray(client.getDebugVisualizerCamera()[2], dtype=np.float64)


@on_linux
def test_missing_x_server_is_an_error() -> None:
    code = (
        "from handover_marl.errors import SimulationError\n"
        "from handover_marl.simulation.bullet.client import connect\n"
        "try:\n    connect(window=True)\n"
        "except SimulationError as error:\n    print('error:', error)\n"
    )
    done = run(code, {**os.environ, "DISPLAY": ":77"})
    assert done.returncode == 0
    assert "error:" in done.stdout
    assert "xvfb-run" in done.stdout
    assert "rgb_array" in done.stdout


@on_linux
def test_missing_x11_library_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.setattr(ctypes, "CDLL", missing)
    with pytest.raises(SimulationError, match="libX11"):
        connect(window=True)


def test_second_window_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(mode: int) -> int:
        raise pybullet.error("Only one local in-process GUI/GUI_SERVER connection allowed.")

    monkeypatch.setattr(client_module, "_require_screen", lambda: None)
    monkeypatch.setattr(pybullet, "connect", refuse)
    with pytest.raises(SimulationError, match="close the other environment"):
        connect(window=True)


def test_failed_connection_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pybullet, "connect", lambda mode: -1)
    with pytest.raises(SimulationError, match="did not start"):
        connect()


def test_close_after_the_server_has_gone() -> None:
    client = connect()
    client.disconnect()
    client.close()
    client.close()


@on_linux
@pytest.mark.parametrize("closing", ["os.close(2)", "os.close(2); sys.stderr = None", "sys.stderr.close()"])
def test_import_without_stderr(closing: str) -> None:
    done = run(
        f"import os, sys; {closing}; from handover_marl.simulation.bullet.client import connect; "
        f"connect(); print('fine')"
    )
    assert done.returncode == 0
    assert done.stdout == "fine\n"


@on_linux
def test_real_window() -> None:
    needs_screen()
    client = connect(window=True)
    with pytest.raises(SimulationError, match="close the other environment"):
        connect(window=True)
    default = CameraConfig()
    expected = client.computeViewMatrix(default.position, default.target, (0.0, 0.0, 1.0))
    # The window is drawn in a separate thread, so that the view changes some time later.
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline and not np.allclose(view_matrix(client), expected, atol=1e-4):
        time.sleep(0.05)
    np.testing.assert_allclose(view_matrix(client), expected, atol=1e-4)
    client.close()
    client.close()


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("file", ["body.urdf", "body.obj"])
def test_unreadable_files_of_a_model(file: str, kind: str, tmp_path: Path) -> None:
    client = connect()
    urdf = write_model(tmp_path, "body.obj")
    replace_by(kind, tmp_path / file)
    with refuses_within(5.0, SimulationError, kind):
        load_urdf(client, urdf)
    client.close()


_READ_MODELS = """
import locale, sys
from pathlib import Path
from handover_marl.assets.robot_model import PANDA_URDF
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_shapes
from handover_marl.simulation.bullet.client import connect, load_urdf
from handover_marl.simulation.bullet.sleepable_bodies import create_collision_shape

locale.setlocale(locale.LC_NUMERIC, sys.argv[1])
client = connect()
panda = load_urdf(client, PANDA_URDF)
shapes = read_urdf_shapes(PANDA_URDF, read_tree(PANDA_URDF), "collision")
number = create_collision_shape(client, shapes[0])
print(client.getAABB(client.createMultiBody(baseMass=1.0, baseCollisionShapeIndex=number)))
for link in range(client.getNumJoints(panda)):
    print(client.getDynamicsInfo(panda, link), client.getJointInfo(panda, link), client.getAABB(panda, link))
assert locale.setlocale(locale.LC_NUMERIC) == sys.argv[1]
"""


def test_numbers_of_models_do_not_depend_on_the_locale(tmp_path: Path) -> None:
    env = install_comma_locale(tmp_path)
    with_point, with_comma = (
        subprocess.run(
            [sys.executable, "-c", _READ_MODELS, name], env=env, stdout=subprocess.PIPE, text=True, check=True
        ).stdout
        for name in ("C", COMMA)
    )
    assert with_point == with_comma
