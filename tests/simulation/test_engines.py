"""Tests of the available kinds of physics, with and without MuJoCo installed."""

import importlib.util

import pytest

from handover_marl.episode.episode import Episode
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.simulation.engines import PHYSICS, check_physics, list_available_physics


def test_names() -> None:
    assert PHYSICS == ("exact", "fast", "mujoco")
    with pytest.raises(UnknownNameError, match="valid: exact, fast, mujoco"):
        check_physics("nuclear")


def test_without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "mujoco" else find(name, *rest)
    )
    assert list_available_physics() == ("exact", "fast")
    with pytest.raises(OptionError, match=r"needs MuJoCo.*Python 3\.11 and later"):
        Episode("mujoco")
    check_physics("fast")


def test_with_mujoco() -> None:
    there = importlib.util.find_spec("mujoco") is not None
    assert ("mujoco" in list_available_physics()) == there
