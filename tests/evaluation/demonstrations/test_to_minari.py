"""Tests of the conversion to Minari's format, with Minari's own reader."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from handover_marl import Demonstrations
from handover_marl.cli import main
from handover_marl.errors import OptionError
from handover_marl.evaluation.demonstrations.convert import convert_to_minari
from tests.evaluation.demonstrations.recording import SCENES


@pytest.fixture(autouse=True)
def minari_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder where Minari stores data sets in a test."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


def test_minari_reads_the_data_set(out: Path, minari_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    ours = Demonstrations(out)
    assert main(["convert", str(out), "--to", "minari", "--name", "handover/moving-v0"]) == 0
    assert f"Data set: {minari_folder / 'handover' / 'moving-v0'}" in capsys.readouterr().out
    dataset = minari.load_dataset("handover/moving-v0")
    assert dataset.observation_space == ours.observation_space
    assert dataset.action_space == ours.action_space
    assert (dataset.total_episodes, dataset.total_steps) == (2, sum(map(len, ours)))
    assert dataset.storage.metadata["algorithm_name"] == "moving"
    stored = list(dataset.storage.get_episode_metadata([0, 1]))
    assert [metadata["options"]["scene_id"] for metadata in stored] == list(SCENES)
    for episode, metadata, demonstration in zip(dataset, stored, ours, strict=True):
        for name in ("actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(episode, name), getattr(demonstration, name), strict=True)
        assert set(episode.observations) == set(demonstration.observations)
        for name, array in demonstration.observations.items():
            np.testing.assert_array_equal(episode.observations[name], array, err_msg=name, strict=True)
        np.testing.assert_array_equal(episode.infos["steps"], demonstration.steps)
        np.testing.assert_array_equal(episode.infos["giver_actions"], demonstration.hold_giver_actions())
        assert {name: metadata[name] for name in demonstration.metadata} == demonstration.metadata
    assert len(dataset.filter_episodes(lambda episode: bool(episode.truncations[-1]))) == 2
    with pytest.raises(OptionError, match=r"name must be a new data set of Minari, got 'handover/moving-v0' .*exists"):
        convert_to_minari(out, "handover/moving-v0")


def test_without_minari(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "minari" else found(name))
    with pytest.raises(OptionError, match=r"needs minari: pip install 'handover-marl\[minari\]'"):
        convert_to_minari(out, "handover/moving-v0")
