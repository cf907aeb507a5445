"""Tests that results do not depend on what the program that calls the library has set in its process."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.integration import process_settings

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


def test_settings_of_the_process_change_no_episode(tmp_path: Path) -> None:
    """Hashes in a process with other settings equal those in this one."""
    env = process_settings.install_comma_locale(tmp_path / "locales") | {"PYTHONPATH": str(ROOT)} | VARIABLES
    for module in MODULES:
        (tmp_path / f"{module}.py").write_text("raise ImportError('a file of the working folder')")
    command = [sys.executable, process_settings.__file__]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.partition("hashes:")[2]) == process_settings.hash_results()
