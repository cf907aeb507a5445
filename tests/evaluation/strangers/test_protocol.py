"""Tests of the evaluation with the partners of a population."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.reports.tables import compute_wilson_interval
from handover_marl.evaluation.strangers import protocol
from handover_marl.evaluation.strangers.protocol import make_leaderboard
from handover_marl.evaluation.strangers.report import StrangersReport, read_report
from handover_marl.policies.populations import load_population
from tests.evaluation.strangers.populations import write_population
from tests.helpers.short_episodes import shorten_episodes

SCENES = (9, 14)


@pytest.fixture(scope="module")
def population(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_population(tmp_path_factory.mktemp("population"))


@pytest.fixture(scope="module")
def evaluated(fake_data: Path, population: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an evaluation of `hold`; do not write to it."""
    with pytest.MonkeyPatch.context() as patch:
        shorten_episodes(patch, 300)
        run(fake_data, population, out=(out := tmp_path_factory.mktemp("evaluated")))
    return out


def run(data: Path, population: Path, **options: Any) -> StrangersReport:
    chosen = {"receiver": "hold", "scenes": SCENES, "setup": "s0", "split": "val", "workers": 1, "progress": False}
    return handover_marl.strangers(population=population, data_dir=data, **chosen | options)


@pytest.mark.slow
def test_report_and_files(fake_data: Path, population: Path, evaluated: Path, tmp_path: Path) -> None:
    # Two scenes for each of two partners; the rate with the worst partner is one of two episodes.
    for key, n in (("success", 4), ("worst_partner_success", 2), ("largest_partner_contact", 2)):
        found = read_report(evaluated, load_population(population)).estimate_all()[key]
        assert found.mean == 0.0
        assert found.interval_95 == pytest.approx(compute_wilson_interval(0, n), abs=1e-12)
    assert str(population.parent) not in (evaluated / "strangers.json").read_text()
    text = (evaluated / "strangers.md").read_text()
    for words in ("Receiver hold with 2 givers of small 1.0", "fast physics", "seed 0"):
        assert words in text
    # The same call computes the same tables from the stored results, without a simulation.
    out = shutil.copytree(evaluated, tmp_path / "out")
    report = run(fake_data, population, out=out)
    assert report.scores.shape == (1, 2, 2)
    assert report.families == {"timing": [0, 1]}
    assert all(each.n_resumed == 2 for each in report.reports.values())
    assert (out / "strangers.json").read_text() == (evaluated / "strangers.json").read_text()
    for options in ({"partners": "all"}, {"receiver": "random"}):
        with pytest.raises(OptionError, match=r"out must be a folder of this receiver, .* is of receiver hold"):
            run(fake_data, population, out=out, **options)
    # A run of fewer scenes: only these are read again.
    run(fake_data, population, out=out, scenes=SCENES[1:])
    assert read_report(out, load_population(population)).scores.shape == (1, 2, 1)


def test_evenly_spaced_scenes_and_receivers_as_partners(
    fake_data: Path, population: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, 100)
    report = run(fake_data, population, receiver=None, giver=["replay", "hesitant"], scenes=None, n_scenes=1)
    assert report.policies == ("replay", "hesitant")
    assert report.scores.shape == (2, 1, 1)
    assert "Giver replay, hesitant with 1 receivers" in str(report)


def make_changed_leaderboard(
    monkeypatch: pytest.MonkeyPatch, folder: Path, population: Path, names: list[str], *changes: dict[str, Any]
) -> protocol.Leaderboard:
    """Make a leaderboard of copies of an evaluation, each with other metadata or other episodes of all pairs."""
    reports = []
    for change in changes:
        report, pairs = read_report(folder, load_population(population)), {}
        data = {"fingerprint": change["fingerprint"]} if "fingerprint" in change else {}
        for key, pair in report.reports.items():
            episodes = tuple(replace(episode, **data) for episode in pair.episodes)
            metadata = replace(pair.metadata, **{name: change[name] for name in change.keys() - data.keys()})
            pairs[key] = replace(pair, metadata=metadata, episodes=episodes)
        reports.append(replace(report, reports=pairs))
    found = iter(reports)
    monkeypatch.setattr(protocol, "read_report", lambda *_: next(found))
    return make_leaderboard([folder / str(number) for number in range(len(names))], population, names=names)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": "1"}, "seed"),
        ({"giver_hash": "other"}, "partners"),
        ({"fingerprint": "other"}, "data"),
        ({"split": "test", "seed": "1"}, "seed"),
    ],
)
def test_evaluations_of_other_conditions_are_refused(
    monkeypatch: pytest.MonkeyPatch, evaluated: Path, population: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ResultsError, match=f"must have the {message}.* of the other folders"):
        make_changed_leaderboard(monkeypatch, evaluated, population, ["one", "other"], {}, changes)


def test_both_splits_of_a_method_are_side_by_side(
    monkeypatch: pytest.MonkeyPatch, evaluated: Path, population: Path
) -> None:
    splits = [{"split": split} for split in ("val", "val", "test", "test")]
    table = make_changed_leaderboard(monkeypatch, evaluated, population, ["one", "other", "other", "one"], *splits)
    scores, differences, families = table.build_tables()
    assert [row[:2] for row in scores.rows] == [["one", "val"], ["one", "test"], ["other", "val"], ["other", "test"]]
    assert [row[:3] for row in differences.rows] == [["one", "other", "val"], ["one", "other", "test"]]
    assert families.header[1:3] == ["one, val: success %", "one, test: success %"]
    assert "2 scenes of val and 2 scenes of test each, fast physics, seed 0" in str(table)


@pytest.mark.slow
def test_leaderboard(population: Path, evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = shutil.copytree(evaluated, tmp_path / "other")
    named = ["strangers-table", f"one={evaluated}", f"another={other}", "--population", str(population)]
    picture = tmp_path / "heat_map.png"
    assert main([*named, "--heat-map", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "| one     | val   | 1         | panda | 0." in printed
    assert "| one    | another | val   |" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main([*named[:2], str(other), *named[3:]]) == 2
    assert "must all have names, or none" in capsys.readouterr().err


@pytest.mark.slow
def test_incomplete_folders_are_refused(population: Path, evaluated: Path, tmp_path: Path) -> None:
    out, second = (shutil.copytree(evaluated, tmp_path / name) for name in ("out", "second"))

    def check(error: type[Exception], message: str, *folders: Path, **options: Any) -> None:
        with pytest.raises(error, match=message):
            make_leaderboard(folders, **{"population": population, **options})

    check(OptionError, "got 0 folders")
    check(OptionError, "got 1 folders and 2 names", evaluated, names=["a", "b"])
    check(OptionError, "must have one evaluation of 'hold' with the split val, got another one", evaluated, out)
    check(OptionError, "must be of population", evaluated, population=write_population(tmp_path, version="2.0"))
    check(ResultsError, "if it was interrupted", tmp_path)
    content = json.loads((out / "strangers.json").read_text())
    pairs = [path.parent for path in sorted(second.glob("*/config.yaml"))]
    for pair in pairs:
        next(pair.glob("*.npz")).unlink()
    names = ["one", "other"]
    check(ResultsError, "must have the data and scenes of the other folders", evaluated, second, names=names)
    next((out / pairs[1].name).glob("*.npz")).unlink()
    check(ResultsError, "must have the scenes and data of the other pairs", out)
    shutil.rmtree(out / pairs[1].name)
    check(ResultsError, "does not exist", out)
    for change, message in (
        ({"partner_split": "train"}, "must have the 1 partners of 'train', got 2"),
        ({"agent": "other"}, "not a readable evaluation"),
    ):
        (second / "strangers.json").write_text(json.dumps(content | change))
        check(ResultsError, message, second)
