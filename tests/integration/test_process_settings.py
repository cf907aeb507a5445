"""Tests that results do not depend on what the program that calls the library has set in its process."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.comma_locale import install_comma_locale
from tests.integration.process_settings import __file__ as script

ROOT = Path(__file__).parents[2]
#: Settings of Python and of the system, and of PyTorch.
PYTHON = "locale,umask,garbage,decimal,generators,numpy,warnings"
PYTORCH = "bfloat16,autocast,precision,device,deterministic,threads,gradients"
#: Variables that change formats, hashes, optimization, and the number of threads.
VARIABLES = {
    "COLUMNS": "1",
    "LANG": "fr_FR.UTF-8",
    "OMP_NUM_THREADS": "2",
    "OPENBLAS_NUM_THREADS": "2",
    "PYTHONHASHSEED": "5",
    "PYTHONOPTIMIZE": "2",
    "TZ": "Asia/Kolkata",
}
#: Files of the working folder that have names of modules.
MODULES = ("assets", "givers", "receivers", "handover_marl", "numpy", "json", "torch", "mujoco", "pybullet")


def play(settings: str, folder: Path, variables: dict[str, str], physics: str) -> dict[str, str]:
    """Play short episodes of the shipped policies in a process of its own; return a hash of each."""
    env = install_comma_locale(folder / "locales") | {"PYTHONPATH": str(ROOT)} | variables
    for module in MODULES:
        (folder / f"{module}.py").write_text("raise ImportError('a file of the working folder')")
    command = [sys.executable, script, settings, physics, "200"]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, str] = json.loads(done.stdout.partition("hashes:")[2])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["exact", "fast", "mujoco"])
def test_episodes_are_equal_to_the_bit(tmp_path: Path, physics: str) -> None:
    first, second, third = (tmp_path / name for name in ("first", "second", "third"))
    for folder in (first, second, third):
        folder.mkdir()
    expected = play("none", first, dict(os.environ), physics)
    assert play(PYTHON, second, VARIABLES, physics) == expected
    assert play(PYTORCH, third, {}, physics) == expected
