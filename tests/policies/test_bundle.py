"""Tests of bundles of policies, which are sent to machines that have other files."""

import importlib
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataNotFoundError, PolicyError
from handover_marl.learning.adapters.function_policy import DEFAULT_GIVER_FILE
from handover_marl.policies.reference import PolicyBundle, parse_policy
from handover_marl.receivers.baselines import HoldReceiver
from handover_marl.version import __version__

CODE = """
from handover_marl.receivers import Receiver
from sway_of_mine import SWAY

class Mine(Receiver):
    name = "mine"

    def reset(self, seed=None):
        pass

    def act(self, observation):
        return observation["robot_joint_position"] + SWAY
"""


class Reads(HoldReceiver):
    """Receiver that reads a constant from a file, or from all files of a folder."""

    name = "reads"
    file_options = ("weights",)

    def __init__(self, context: Any, weights: str, other: str = "") -> None:
        path = Path(weights)
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        self.names = [path.name, *(file.name for file in files if path.is_dir())]
        self.constant = sum(float(file.read_text()) for file in files)
        self.other = other


@pytest.mark.parametrize("folder", [False, True])
def test_files_go_along(tmp_path: Path, folder: bool) -> None:
    given = tmp_path / "here" / "weights.txt"
    given.parent.mkdir()
    given.write_text("1.5")
    (given.parent / "more.txt").write_text("2.0")
    named = given.parent if folder else given
    reference = parse_policy("receiver", (Reads, {"weights": str(named), "other": str(given)}))
    reference = reference.resolve(SyntheticDataset())
    bundle = PolicyBundle.pack(reference)
    shutil.rmtree(given.parent)
    there = bundle.unpack(tmp_path / "there")
    made = there.make(SyntheticDataset())
    assert isinstance(made, Reads)
    assert made.constant == (3.5 if folder else 1.5)
    assert made.names == (["here", "more.txt", "weights.txt"] if folder else ["weights.txt"])
    assert made.other == str(given), "what names no file stays as it is"
    assert (there.label, there.code_hash) == (reference.label, reference.code_hash)


def test_policy_files_go_along(tmp_path: Path) -> None:
    given = tmp_path / "mine.npz"
    shutil.copy(DEFAULT_GIVER_FILE, given)
    reference = parse_policy("giver", f"learned:{given}").resolve(SyntheticDataset())
    bundle = PolicyBundle.pack(reference)
    given.unlink()
    with pytest.raises(DataNotFoundError):
        reference.make(SyntheticDataset())
    assert bundle.unpack(tmp_path / "there").make(SyntheticDataset()).label == reference.label
    with pytest.raises(DataNotFoundError, match=r"mine\.npz cannot be read"):
        PolicyBundle.pack(reference)


def test_code_that_is_sent_is_not_compared() -> None:
    class Local(Reads):
        pass

    for kind in (Local, type("Typed", (Local,), {"__module__": "__main__"})):
        assert PolicyBundle.pack(parse_policy("receiver", (kind, {"weights": __file__}))).packages == ()
    assert PolicyBundle.pack(parse_policy("receiver", (Reads, {"weights": __file__}))).packages[0][0] == "tests"
    assert PolicyBundle.pack(parse_policy("receiver", "yang2021")).packages == (("handover_marl", __version__),)


def test_other_code_there_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    homes = [tmp_path / name for name in ("here", "copy", "other")]
    for home in homes:
        home.mkdir()
        (home / "robots_of_mine.py").write_text(CODE)
        (home / "sway_of_mine.py").write_text(f"SWAY = {0.1 if home.name == 'other' else 0.0}\n")

    def at(home: Path | None) -> None:
        """Make the code importable from one folder only, as on a machine that has it there; from none if it is None."""
        for name in ("robots_of_mine", "sway_of_mine"):
            sys.modules.pop(name, None)
        monkeypatch.setattr(
            sys, "path", [path for path in sys.path if Path(path) not in homes] + [str(home)] * bool(home)
        )
        importlib.invalidate_caches()

    for named in ("robots_of_mine:Mine", None):
        at(homes[0])
        kind = named or importlib.import_module("robots_of_mine").Mine
        bundle = PolicyBundle.pack(parse_policy("receiver", kind))
        at(homes[1])
        assert bundle.unpack(tmp_path).policy_class.name == "mine"
        at(homes[2])
        with pytest.raises(
            PolicyError, match=r"on node .*Mine' must be installed as here, got PolicyError: it has other code"
        ):
            bundle.unpack(tmp_path)
        at(None)
        with pytest.raises(PolicyError, match=r"on node .*Mine' must be installed as here, got .*robots_of_mine"):
            bundle.unpack(tmp_path)
