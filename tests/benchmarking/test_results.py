import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.results import ResultFolder, RunSettings, read_results, read_settings
from handover_marl.errors import ResultsError
from handover_marl.protocol.status import EpisodeStatus

SETTINGS = RunSettings("s0", "test", "hold", "replay", "exact", "dexycb", "1.0")
RESULT = EpisodeResult(
    index=0,
    status=EpisodeStatus.TIMEOUT,
    steps=50,
    plan_time=0.5,
    scene_id=9,
    object_name="003_cracker_box",
    subject="20200709-subject-01",
    side="right",
    n_objects=1,
    fingerprint="abc",
    machine="m",
)


@pytest.fixture
def folder(tmp_path: Path) -> ResultFolder:
    """A folder with one result."""
    made = ResultFolder(tmp_path, SETTINGS)
    made.save(RESULT, np.zeros((50, 9), np.float32), np.full(50, 0.01))
    return made


def test_results_come_back(folder: ResultFolder) -> None:
    assert read_settings(folder.path) == SETTINGS
    [result] = read_results(folder.path)
    assert result.plan_time == pytest.approx(0.5)
    assert result == folder.finished(0, "abc")
    assert {**vars(result), "plan_time": 0.5} == vars(RESULT)
    assert folder.finished(1, "abc") is None


def change_config(path: Path, section: str, value: object) -> None:
    config = yaml.safe_load((path / "config.yaml").read_text())
    config[section] = {**config[section], **value} if isinstance(value, dict) else value
    (path / "config.yaml").write_text(yaml.safe_dump(config))


@pytest.mark.parametrize("key", ["SETUP", "SPLIT"])
@pytest.mark.parametrize("value", ["s9", ["s0"], 3, None, {"s0": 1}])
@pytest.mark.parametrize("own", [True, False])
def test_setup_and_split_must_be_official(folder: ResultFolder, key: str, value: object, own: bool) -> None:
    change_config(folder.path, "BENCHMARK", {key: value})
    if not own:
        change_config(folder.path, "HANDOVER_MARL", None)
    with pytest.raises(ResultsError, match=r"config\.yaml: unknown setup"):
        read_settings(folder.path)


@pytest.mark.parametrize("key", ["receiver", "giver", "physics", "dataset", "version"])
@pytest.mark.parametrize("value", [3, None, ["hold"], 1.5, True])
def test_own_section_is_text(folder: ResultFolder, key: str, value: object) -> None:
    change_config(folder.path, "HANDOVER_MARL", {key: value})
    with pytest.raises(ResultsError, match=rf"config\.yaml: {key} .*expected text"):
        read_settings(folder.path)


@pytest.mark.parametrize("value", [[1], "text", 3, {"colour": "red"}, {"setup": "s0"}, {3: "x"}])
def test_own_section_of_another_kind(folder: ResultFolder, value: object) -> None:
    change_config(folder.path, "HANDOVER_MARL", value)
    with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
        read_settings(folder.path)


@pytest.mark.parametrize("text", ["", "3", "[1]", "x: [", "BENCHMARK: 2020-99-99", "[" * 5000])
def test_configurations_that_are_none(folder: ResultFolder, text: str) -> None:
    (folder.path / "config.yaml").write_text(text)
    with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
        read_settings(folder.path)


@pytest.mark.parametrize(
    "changes",
    [
        {"machine": 3},
        {"object_name": np.array(["a", "b"])},
        {"subject": 1.5},
        {"side": np.array(b"right")},
        {"fingerprint": False},
        {"scene_id": "abc"},
        {"scene_id": np.array([1, 2])},
        {"n_objects": 1.0},
        {"release_step": True},
        {"elapsed_time": np.array(["a"])},
        {"elapsed_time": np.full(50, -1.0)},
        {"elapsed_time": np.full(50, np.nan)},
    ],
)
def test_values_of_another_kind(folder: ResultFolder, changes: dict[str, Any]) -> None:
    path = folder.path / "000.npz"
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, **changes})
    with pytest.raises(ResultsError, match=r"000\.npz"):
        read_results(folder.path)
    assert folder.finished(0, "abc") is None


def test_files_of_another_kind_are_unfinished(folder: ResultFolder) -> None:
    path = folder.path / "000.npz"
    whole = path.read_bytes()
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    with pytest.raises(ResultsError, match=r"000\.npz: no readable result file"):
        read_results(folder.path)
    assert folder.finished(0, "abc") is None
    # The central directory's flag for encrypted entries.
    start = whole.rindex(b"PK\x01\x02", 0, whole.rindex(b"result.npy"))
    path.write_bytes(whole[: start + 8] + b"\x01" + whole[start + 9 :])
    assert folder.finished(0, "abc") is None


def test_flipped_bytes_in_result_files(folder: ResultFolder) -> None:
    path, rng = folder.path / "000.npz", random.Random(0)
    whole = path.read_bytes()
    refused = 0
    for _ in range(600):
        spoilt = bytearray(whole)
        for _ in range(rng.choice((1, 1, 2, 8))):
            spoilt[rng.randrange(len(spoilt))] = rng.randrange(256)
        path.write_bytes(spoilt)
        try:
            read_results(folder.path)
        except ResultsError:
            refused += 1
    assert refused > 200
