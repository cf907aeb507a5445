"""Tests that results do not depend on what the program that calls the library has set in its process."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.comma_locale import install_comma_locale
from tests.integration.process_settings import __file__ as script

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
#: Settings of Python and of the system, and of PyTorch.
PYTHON = "locale,umask,garbage,decimal,generators,numpy,warnings"
PYTORCH = "bfloat16,autocast,precision,device,deterministic,threads,gradients,denormals"
#: Receivers with networks.
WITH_NETWORKS = ("gaddpg", "learned", "vision")
#: Variables that change formats, hashes and the number of threads.
VARIABLES = {
    "COLUMNS": "1",
    "LANG": "fr_FR.UTF-8",
    "OMP_NUM_THREADS": "2",
    "OPENBLAS_NUM_THREADS": "2",
    "PYTHONHASHSEED": "5",
    "TZ": "Asia/Kolkata",
}
#: Files of the working folder that have names of modules.
MODULES = ("assets", "givers", "receivers", "handover_marl", "numpy", "json", "torch", "mujoco", "pybullet")


def play(settings: str, folder: Path, variables: dict[str, str], *receivers: str) -> dict[str, str]:
    """Play short episodes of receivers, default all, in each engine, in a process of its own; return their hashes."""
    env = install_comma_locale(folder / "locales") | {"PYTHONPATH": str(ROOT)} | variables
    for module in MODULES:
        (folder / f"{module}.py").write_text("raise ImportError('a file of the working folder')")
    command = [sys.executable, script, settings, "exact,mujoco", "150", *receivers]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout.partition("hashes:")[2])
    return found


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return play("none", tmp_path_factory.mktemp("none"), {})


def test_settings_of_python_and_the_system_change_no_episode(tmp_path: Path, expected: dict[str, str]) -> None:
    assert play(PYTHON, tmp_path, VARIABLES) == expected


def test_settings_of_pytorch_change_no_episode(tmp_path: Path, expected: dict[str, str]) -> None:
    """Other policies compute without PyTorch."""
    found = play(PYTORCH, tmp_path, {}, *WITH_NETWORKS)
    assert found.items() <= expected.items()
    assert len(found) == 2 * len(WITH_NETWORKS)
