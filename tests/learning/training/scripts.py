"""Import scripts of experiments/ as modules, and read the folders that they write."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

#: Built-in and custom reward terms.
REWARDS = "tests.envs.custom_rewards:SHAPED_AND_OWN"
EXPERIMENTS = Path(__file__).parents[3] / "experiments"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (path,) = EXPERIMENTS.rglob(f"{name}.py")
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}
