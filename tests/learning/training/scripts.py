"""Import scripts of experiments/ as modules, and read the folders that they write."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import handover_marl
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.reports.report import Report
from handover_marl.grasps.validation import GraspPreparationConfig
from handover_marl.receivers.reactive.config import ReactiveConfig

#: Configuration that validates known grasps only, without tilts and offsets, for tests of other things.
QUICK_REACTIVE = ReactiveConfig(
    preparation=GraspPreparationConfig(tilts=(), lateral_offsets=(), release_offsets=(), advances=())
)
#: Built-in and custom reward terms.
REWARDS = "tests.envs.custom_rewards:SHAPED_AND_OWN"
EXPERIMENTS = Path(__file__).parents[3] / "experiments"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (path,) = EXPERIMENTS.rglob(f"{name}.py")
    return import_file(path, monkeypatch)


def import_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import a script, which may import others of its folder, as a module for one test."""
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    return module


def simulate_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trainings simulate environments in this process; receivers of the scheme grasp_servo wait for 0.4 s."""
    make, here = handover_marl.vector_env, {"processes": None, "threads": 1}
    monkeypatch.setattr(handover_marl, "vector_env", lambda *args, **options: make(*args, **options | here))
    monkeypatch.setattr("handover_marl.learning.encodings.schemes.GraspServoScheme.wait", 0.4)


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def evaluate_hold(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Let trainings by imitation evaluate `hold`, whose episodes take less time; return the files of weights."""
    from handover_marl.learning.training import run_folder

    evaluated: list[str] = []

    def evaluate(giver: str, receiver: Any, *split: str, **options: Any) -> Report:
        evaluated.append(Path(receiver[1]["weights"]).name)
        return evaluate_pair(giver, "hold", *split, **options)

    monkeypatch.setattr(run_folder, "evaluate_pair", evaluate)
    return evaluated
