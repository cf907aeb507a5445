"""Import scripts of experiments/ as modules, and read the folders that they write."""

import csv
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


def reward_terms_of(folder: Path, agent: str) -> set[str]:
    """Return the names of an agent's terms in the table of reward terms.

    Check that every term has episodes, and that the means of the receiver's terms are not all 0.
    """
    with (folder / "reward_terms.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["agent"] == agent]
    assert agent == "giver" or any(float(row["mean"]) for row in rows)
    assert all(int(row["episodes"]) > 0 for row in rows)
    return {row["term"] for row in rows}


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def steps_of(folder: Path) -> list[str]:
    """Return the first column of the learning curve."""
    return [row.split(",")[0] for row in (folder / "learning_curve.csv").read_text().splitlines()]
