"""Tests of the evaluation with the partners of a population, and of files with reference scores."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.errors import DataFormatError, DataNotFoundError, OptionError, ResultsError
from handover_marl.evaluation.reports.tables import compute_wilson_interval
from handover_marl.evaluation.strangers import protocol
from handover_marl.evaluation.strangers.protocol import make_leaderboard, update_references
from handover_marl.evaluation.strangers.references import Condition, Reference, ReferenceTable, load_references
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
    for words in ("Receiver hold with 2 givers of small 1.0", "fast physics", "No BR-Prox", "seed 0"):
        assert words in text
    # The same call computes the same tables from the stored results, without a simulation.
    out = shutil.copytree(evaluated, tmp_path / "out")
    report = run(fake_data, population, out=out)
    assert report.scores.shape == (1, 2, 2)
    assert report.families == {"timing": [0, 1]}
    assert all(each.n_resumed == 2 for each in report.reports.values())
    assert (out / "strangers.json").read_text() == (evaluated / "strangers.json").read_text()
    with pytest.raises(OptionError, match="out must be a folder for population"):
        run(fake_data, population, out=out, partners="all")


@pytest.mark.slow
def test_references_of_evaluations(fake_data: Path, evaluated: Path, tmp_path: Path) -> None:
    population = write_population(tmp_path)
    summary = update_references([evaluated], population)
    assert [(row[0], row[3]) for row in summary.build_tables()[0].rows] == [("fast", "hold"), ("slow", "hold")]
    command = next(iter(summary.sections.values()))["fast"].command
    assert command.startswith("handover-marl pair --giver hurried:min_rate=0.5,max_rate=0.6 --receiver hold --dataset ")
    assert "--physics fast --robot panda --seed 0 --scenes " in command
    out = shutil.copytree(evaluated, tmp_path / "out")
    found = run(fake_data, population, out=out)
    # In folders of other evaluations, both agents can become references.
    (out / "strangers.json").unlink()
    both = update_references([out], population, tmp_path / "both.json")
    assert [row[0] for row in both.build_tables()[0].rows] == ["fast", "slow", "still"]
    # The reference scores of both partners are zero, so that every score counts as having reached them. The policy is
    # compared with itself, so that there is no interval.
    estimates = found.estimate_all()
    assert (estimates["br_prox"].mean, estimates["br_prox"].interval_95) == (1.0, None)
    assert estimates["worst_br_prox"].interval_95 is None
    assert ["BR-Prox %", "100.0"] in [list(row) for row in found.build_tables()[0].rows]
    assert found.references is not None
    others = replace(found, references=tuple(replace(each, policy="best") for each in found.references))
    assert others.estimate_all()["br_prox"].interval_95 is not None


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
    picture, references = tmp_path / "heat_map.png", tmp_path / "references.json"
    assert main([*named, "--heat-map", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "| one     | val   | 1         | panda | 0." in printed
    assert "| one    | another | val   |" in printed
    # Without stored references there is no score relative to the best of the methods.
    assert "No BR-Prox: a partner has no reference" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    update_references([evaluated], population, references)
    assert main([*named, "--references", str(references)]) == 0
    printed = capsys.readouterr().out
    assert "AS of the best policy known" in printed
    assert "No BR-Prox" not in printed
    assert main([*named, "--references", str(tmp_path / "absent.json")]) == 2
    assert "references must be a file that" in capsys.readouterr().err
    assert main([*named[:2], str(other), *named[3:]]) == 2
    assert "must all have names, or none" in capsys.readouterr().err


@pytest.mark.slow
def test_incomplete_folders_are_refused(population: Path, evaluated: Path, tmp_path: Path) -> None:
    out, second = (shutil.copytree(evaluated, tmp_path / name) for name in ("out", "second"))

    def check(error: type[Exception], message: str, *folders: Path, **options: Any) -> None:
        with pytest.raises(error, match=message):
            make_leaderboard(folders, **{"population": population, **options})

    check(OptionError, "at least one folder")
    check(OptionError, "must have one evaluation of 'hold' with the split val, got", evaluated, out)
    check(OptionError, "must be of population", evaluated, population=write_population(tmp_path, version="2.0"))
    check(ResultsError, "is not finished", tmp_path)
    content = json.loads((out / "strangers.json").read_text())
    for name in content["folders"]["hold"].values():
        next((second / name).glob("*.npz")).unlink()
    names = ["one", "other"]
    check(ResultsError, "must have the data and scenes of the other folders", evaluated, second, names=names)
    next((out / content["folders"]["hold"]["fast"]).glob("*.npz")).unlink()
    check(ResultsError, "must have the scenes and data of the other pairs", out)
    for folders, message in (
        ({"slow": "x"}, "must have the partners of 'test', got others"),
        ({"fast": "../other", "slow": "x"}, "not a readable evaluation"),
        ({"fast": "x", "slow": "x"}, "does not exist"),
    ):
        (out / "strangers.json").write_text(json.dumps(content | {"folders": {"hold": folders}}))
        check(ResultsError, message, out)


CONDITION = Condition("receiver", "dexycb", "s0", "train", "fast", "0", "0.8.0", (3, 5, 9), ("a", "b", "c"))
GOOD = Reference("reactive", "0.8.0 abc", "handover-marl pair", (0.5, 0.0, 0.7))
BAD = Reference("hold", "0.8.0 abc", "handover-marl pair", (0.0, 0.3, 0.0))
POPULATION = load_population()
EMPTY = ReferenceTable(POPULATION, {})


def test_the_best_policy_stays() -> None:
    table = EMPTY.update(CONDITION, "fast", BAD).update(CONDITION, "fast", GOOD).update(CONDITION, "fast", BAD)
    assert table.sections[CONDITION]["fast"] == GOOD
    assert table.find(CONDITION, "fast") == GOOD


def test_scores_of_some_of_the_scenes() -> None:
    single = replace(CONDITION, scenes=(5,), data=("b",))
    table = EMPTY.update(CONDITION, "fast", GOOD).update(single, "fast", replace(BAD, scores=(0.3,)))
    assert table.find_all(replace(CONDITION, scenes=(3, 9), data=("a", "c")), ["fast"]) == (
        replace(GOOD, scores=(0.5, 0.7)),
    )
    # For scene 5, a higher score of another policy is stored under another condition.
    assert table.find_all(single, ["fast"]) == (replace(BAD, scores=(0.3,)),)
    assert table.find_all(CONDITION, ["fast", "slow"]) is None


def test_references_of_other_conditions_are_not_used() -> None:
    table = EMPTY.update(CONDITION, "fast", GOOD)
    others: list[dict[str, Any]] = [{"scenes": (3, 4), "data": ("a", "b")}, {"data": ("a", "b", "other hash")}]
    for changes in [*others, {"physics": "exact"}, {"split": "val"}, {"seed": "1"}, {"version": "0.9.0"}]:
        assert table.find(replace(CONDITION, **changes), "fast") is None


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "references.json"
    assert load_references(POPULATION, path, is_new=True) == EMPTY
    with pytest.raises(DataNotFoundError, match="references must be a file that"):
        load_references(POPULATION, path)
    table = EMPTY.update(CONDITION, "fast", GOOD)
    path.write_text(table.to_json())
    assert load_references(POPULATION, path) == table
    with pytest.raises(DataFormatError, match="must be of population def, got"):
        load_references(replace(POPULATION, content_hash="def"), path)
    for text in ("{", '{"population_hash": "", "sections": [1]}', path.read_text().replace("0.7", "0.7, 0.1")):
        path.write_text(text)
        with pytest.raises(DataFormatError, match="not a readable file of references"):
            load_references(POPULATION, path)
