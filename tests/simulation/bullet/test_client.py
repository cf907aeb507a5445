"""Tests of PyBullet's client and window: missing screens, second windows, lost connections and viewpoint."""

import os
import subprocess
import sys
from pathlib import Path

import pybullet
import pytest

from handover_marl.errors import SimulationError
from handover_marl.simulation.bullet import client as client_module
from handover_marl.simulation.bullet.client import connect, load_urdf
from tests.comma_locale import COMMA, install_comma_locale
from tests.geometry.test_unreadable_models import write_model
from tests.unreadable import UNREADABLE, refuses_within, replace_by

on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="X11 is Linux's way to a screen")


def run(code: str, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, timeout=120, check=False, env=env
    )


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


@on_linux
def test_import_without_stderr() -> None:
    done = run(
        "import os, sys; os.close(2); sys.stderr = None; from handover_marl.simulation.bullet.client import connect; "
        "connect(); print('fine')"
    )
    assert done.returncode == 0
    assert done.stdout == "fine\n"


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


@pytest.mark.slow
def test_numbers_of_models_do_not_depend_on_the_locale(tmp_path: Path) -> None:
    env = install_comma_locale(tmp_path)
    with_point, with_comma = (
        subprocess.run(
            [sys.executable, "-c", _READ_MODELS, name], env=env, stdout=subprocess.PIPE, text=True, check=True
        ).stdout
        for name in ("C", COMMA)
    )
    assert with_point == with_comma
