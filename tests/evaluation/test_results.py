import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.metadata import ResultMetadata, read_result_metadata
from handover_marl.evaluation.reports.report import evaluate
from handover_marl.evaluation.results import EpisodeResult, ResultFolder, encode_result, read_results

SETTINGS = ResultMetadata("s0", "test", "hold", "replay", "exact", "dexycb", "1.0")
RESULT = EpisodeResult(
    index=0,
    status=EpisodeStatus.TIMEOUT,
    steps=50,
    plan_s=0.5,
    scene_id=209,
    object_name="003_cracker_box",
    subject="20200709-subject-01",
    side="right",
    n_objects=1,
    fingerprint="abc",
    machine="m",
)


CONTENT = encode_result(RESULT, np.zeros((50, 9), np.float32), np.full(50, 0.01))


@pytest.fixture
def folder(tmp_path: Path) -> ResultFolder:
    """Return a folder with one result."""
    made = ResultFolder(tmp_path, SETTINGS)
    made.write(RESULT, CONTENT)
    return made


def test_results_are_read_as_written(folder: ResultFolder) -> None:
    assert read_result_metadata(folder.path) == SETTINGS
    [result] = read_results(folder.path)
    assert result.plan_s == pytest.approx(0.5)
    assert result == folder.read(0, "abc")
    assert {**vars(result), "plan_s": 0.5} == vars(RESULT)
    assert folder.read(1, "abc") is None


@pytest.mark.parametrize(
    "changes",
    [
        {"object_name": np.array(["a", "b"])},
        {"subject": 1.5},
        {"release_step": True},
        {"machine": "a\nb"},
        {"machine": "m" * 5_000_000},
        {"elapsed_time": np.array(["a"])},
        {"elapsed_time": np.full(50, np.nan)},
        {"result": np.inf},
        {"elapsed_frame": 10**15},
        {"scene_id": -1},
    ],
)
def test_values_of_another_type_are_refused(folder: ResultFolder, changes: dict[str, Any]) -> None:
    path = folder.path / "000.npz"
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, **changes})
    with pytest.raises(ResultsError, match=r"000\.npz"):
        read_results(folder.path)
    assert folder.read(0, "abc") is None


def test_a_renamed_result_is_refused(folder: ResultFolder) -> None:
    (folder.path / "000.npz").rename(folder.path / "001.npz")
    with pytest.raises(ResultsError, match=r"001\.npz must be of scene 214, got scene 209; delete it"):
        evaluate(folder.path)


OTHERS = [replace(SETTINGS, receiver="other"), replace(SETTINGS, seed="1"), replace(SETTINGS, receiver_hash="12345678")]


def test_a_folder_belongs_to_its_first_evaluation(tmp_path: Path) -> None:
    for _ in range(2):
        ResultFolder(tmp_path / "out", SETTINGS)
    for other in OTHERS:
        with pytest.raises(ResultsError, match=r"holds another evaluation .*fresh=True"):
            ResultFolder(tmp_path / "out", other)
    assert read_result_metadata(tmp_path / "out") == SETTINGS


def test_a_concurrent_evaluation_that_writes_first_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An evaluation is refused if another one writes its configuration to the folder just before it does."""
    sync, other, came = os.fsync, OTHERS[0], []

    def sync_and_be_overtaken(handle: int) -> None:
        if not came:
            came.append(handle)
            ResultFolder(tmp_path, other)
        sync(handle)

    monkeypatch.setattr(os, "fsync", sync_and_be_overtaken)
    with pytest.raises(ResultsError, match="holds another evaluation"):
        ResultFolder(tmp_path, SETTINGS)
    assert read_result_metadata(tmp_path) == other
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]


@pytest.mark.parametrize("settings", [SETTINGS, OTHERS[0]])
def test_fresh_deletes_only_results(folder: ResultFolder, settings: ResultMetadata) -> None:
    path = folder.path
    for name in ("report.json", "report.md", "012.npz"):
        (path / name).write_text("old")
    others = ["agreement.md", "thesis.tex", "0000.npz", "policy.npz", "12.npz", ".hidden", "x001.npz", "001.npz.bak"]
    for name in others:
        (path / name).write_text("precious")
    (path / "exact").mkdir()
    (path / "exact" / "000.npz").write_text("precious")
    ResultFolder(path, settings, fresh=True)
    assert read_result_metadata(path) == settings
    assert sorted(entry.name for entry in path.iterdir()) == sorted([*others, "config.yaml", "exact"])
    assert all((path / name).read_text() == "precious" for name in others)
    assert (path / "exact" / "000.npz").read_text() == "precious"


@pytest.mark.parametrize("content", ["model: resnet\nlearning_rate: 0.1\n", "BENCHMARK: 3"])
def test_fresh_leaves_foreign_folders_unchanged(tmp_path: Path, content: str) -> None:
    """A folder with the `config.yaml` of another program is refused and not changed, even with `fresh`."""
    (tmp_path / "config.yaml").write_text(content)
    (tmp_path / "000.npz").write_text("precious")
    for fresh in (False, True):
        with pytest.raises(ResultsError, match=r"config\.yaml"):
            ResultFolder(tmp_path, SETTINGS, fresh=fresh)
        assert (tmp_path / "config.yaml").read_text() == content
        assert (tmp_path / "000.npz").read_text() == "precious"
    (tmp_path / "config.yaml").unlink()
    with pytest.raises(ResultsError, match="is no result folder"):
        ResultFolder(tmp_path, SETTINGS, fresh=True)
    assert (tmp_path / "000.npz").read_text() == "precious"


def test_a_copied_result_is_not_counted_twice(folder: ResultFolder) -> None:
    (folder.path / "001.npz").write_bytes((folder.path / "000.npz").read_bytes())
    with pytest.raises(ResultsError, match=r"2 results are of scene 209; delete"):
        read_results(folder.path)


def test_more_steps_than_the_official_horizon(folder: ResultFolder) -> None:
    result = replace(RESULT, status=EpisodeStatus.SUCCESS, steps=10**7)
    folder.write(result, encode_result(result, np.zeros((1, 9), np.float32), np.zeros(1)))
    with pytest.raises(ResultsError, match=r"000\.npz must have at most 13001 steps .*, got 10000000"):
        evaluate(folder.path)
