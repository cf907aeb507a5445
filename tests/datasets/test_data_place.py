from pathlib import Path

import pytest

from handover_marl.datasets import DATA_VARIABLE
from handover_marl.datasets.data_place import DataPlace, check_scene
from handover_marl.errors import DataFormatError


def test_which_folder_another_machine_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one that was given, its own, or the usual one of the machine that asks, in this order."""
    given, usual, own = (tmp_path / name for name in ("given", "usual", "own"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(DATA_VARIABLE, str(usual))
    asked, not_given = DataPlace.of("given"), DataPlace.of(None)
    assert (asked.given, not_given.given, asked.usual) == (str(given), "", str(usual))
    # On a machine that has neither, its own dataset says what is missing.
    monkeypatch.chdir("/")
    monkeypatch.setenv(DATA_VARIABLE, str(own))
    assert asked.here() is not_given.here() is None
    usual.mkdir()
    assert asked.here() is None, "its own comes before another machine's"
    given.mkdir()
    assert asked.here() == str(given)
    assert not_given.here() is None
    monkeypatch.delenv(DATA_VARIABLE)
    assert (asked.here(), not_given.here()) == (str(given), str(usual))
    assert DataPlace.of(None) == DataPlace()


def test_other_scenes_are_refused() -> None:
    check_scene(9, "abc", "abc")
    check_scene(9, "abc", "")
    with pytest.raises(DataFormatError, match=rf"scene 9 on .* \(fingerprint abc there, abd here\).*{DATA_VARIABLE}"):
        check_scene(9, "abc", "abd")
