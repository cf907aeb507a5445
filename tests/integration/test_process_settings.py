"""Tests that results do not depend on what the program that calls the library has set in its process."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.comma_locale import install_comma_locale
from tests.integration.process_settings import __file__ as script

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
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


def play(settings: str, folder: Path, variables: dict[str, str]) -> dict[str, str]:
    """Play short episodes in a process with settings, "none" or "changed"; return their hashes."""
    env = install_comma_locale(folder / "locales") | {"PYTHONPATH": str(ROOT)} | variables
    for module in MODULES:
        (folder / f"{module}.py").write_text("raise ImportError('a file of the working folder')")
    command = [sys.executable, script, settings, "120"]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout.partition("hashes:")[2])
    return found


def test_settings_of_the_process_change_no_episode(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("none", "changed")]
    for folder in folders:
        folder.mkdir()
    assert play("changed", folders[1], VARIABLES) == play("none", folders[0], {})
