from pathlib import Path

import pytest

from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.registry import DataLocation, check_scene_fingerprint
from handover_marl.errors import DataFormatError


def test_data_folder_of_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order is: the argument, a machine's own environment variable, that of the machine that starts."""
    argument, environment, own = (tmp_path / name for name in ("given", "usual", "own"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(environment))
    asked, not_given = DataLocation.from_data_dir("given"), DataLocation.from_data_dir(None)
    assert (asked.argument, not_given.argument, asked.environment) == (str(argument), "", str(environment))
    # On a machine that has neither folder, the machine's own environment variable is used.
    monkeypatch.chdir("/")
    monkeypatch.setenv(DATA_DIR_VARIABLE, str(own))
    assert asked.resolve() is not_given.resolve() is None
    environment.mkdir()
    assert asked.resolve() is None, "its own comes before another machine's"
    argument.mkdir()
    assert asked.resolve() == str(argument)
    assert not_given.resolve() is None
    monkeypatch.delenv(DATA_DIR_VARIABLE)
    assert (asked.resolve(), not_given.resolve()) == (str(argument), str(environment))
    assert DataLocation.from_data_dir(None) == DataLocation()


def test_different_scenes_are_refused() -> None:
    check_scene_fingerprint(9, "abc", "abc")
    check_scene_fingerprint(9, "abc", "")
    with pytest.raises(
        DataFormatError, match=rf"scene 9 on .* \(fingerprint abc there, abd here\).*{DATA_DIR_VARIABLE}"
    ):
        check_scene_fingerprint(9, "abc", "abd")
