"""Tests of the evaluation with the partners of a population, with policies that take little time."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.config import WorldConfig
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.reports.tables import compute_wilson_interval
from handover_marl.evaluation.strangers import protocol
from handover_marl.evaluation.strangers.protocol import make_leaderboard, update_references
from handover_marl.evaluation.strangers.report import StrangersReport, read_report
from handover_marl.policies.populations import POPULATION_FOLDER
from tests.evaluation.strangers.populations import write_population

SCENES = (9, 14)


@pytest.fixture(scope="module")
def population(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_population(tmp_path_factory.mktemp("population"))


@pytest.fixture(scope="module")
def evaluated(fake_data: Path, population: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an evaluation of `hold`; do not write to it."""
    out = tmp_path_factory.mktemp("evaluated")
    run(fake_data, population, out=out)
    return out


def run(data: Path, population: Path, **options: Any) -> StrangersReport:
    chosen = {"receiver": "hold", "scenes": SCENES, "setup": "s0", "split": "val", "workers": 1, "progress": False}
    return handover_marl.strangers(population=population, data_dir=data, **chosen | options)


@pytest.mark.slow
def test_report_and_files(fake_data: Path, population: Path, evaluated: Path, tmp_path: Path) -> None:
    # Two scenes for each of two partners; the rate with the worst partner is one of two episodes.
    for key, n in (("success", 4), ("worst_partner_success", 2), ("largest_partner_contact", 2)):
        found = read_report(evaluated).estimate_all()[key]
        assert found.value == 0.0
        assert found.interval_95 == pytest.approx(compute_wilson_interval(0, n), abs=1e-12)
    assert str(population.parent) not in (evaluated / "strangers.json").read_text()
    text = (evaluated / "strangers.md").read_text()
    assert "Receiver hold with 2 givers of small 1.0" in text
    assert "fast physics" in text
    assert "No BR-Prox" in text
    assert "seed 0" in text
    # The same call computes the same tables from the stored results, without a simulation.
    out = tmp_path / "out"
    shutil.copytree(evaluated, out)
    report = run(fake_data, population, out=out)
    assert report.scores.shape == (1, 2, 2)
    assert report.families == ("timing",)
    assert report.references is None
    assert all(each.n_resumed == 2 for each in report.reports.values())
    assert (out / "strangers.json").read_text() == (evaluated / "strangers.json").read_text()
    with pytest.raises(OptionError, match="out must be a folder for population"):
        run(fake_data, population, out=out, partners="all")


def test_references_of_evaluations(fake_data: Path, evaluated: Path, tmp_path: Path) -> None:
    population, out = write_population(tmp_path), tmp_path / "out"
    summary = update_references([evaluated], population)
    rows = summary.build_sections()[1].rows
    assert [row[0] for row in rows] == ["fast", "slow"]
    assert [row[3] for row in rows] == ["hold", "hold"]
    command = next(iter(summary.sections.values()))["fast"].command
    assert command.startswith("handover-marl pair --giver hurried:min_rate=0.5,max_rate=0.6 --receiver hold --dataset ")
    assert "--physics fast --robot panda --seed 0 --scenes " in command
    shutil.copytree(evaluated, out)
    found = run(fake_data, population, out=out)
    assert found.references is not None
    (out / "strangers.json").unlink()
    both = update_references([out], population, tmp_path / "both.json")
    assert [row[0] for row in both.build_sections()[1].rows] == ["fast", "slow", "still"]
    # The reference scores of both partners are zero, so that every score counts as having reached them. The policy is
    # compared with itself, so that there is no interval.
    estimates = found.estimate_all()
    assert (estimates["br_prox"].value, estimates["br_prox"].interval_95) == (1.0, None)
    assert estimates["worst_br_prox"].interval_95 is None
    assert ["BR-Prox %", "100.0"] in [list(row) for row in found.build_tables()[0].rows]
    assert found.references is not None
    others = replace(found, references=tuple(replace(each, policy="best") for each in found.references))
    assert others.estimate_all()["br_prox"].interval_95 is not None


@pytest.mark.slow
def test_evenly_spaced_scenes_and_receivers_as_partners(fake_data: Path, population: Path) -> None:
    report = run(fake_data, population, receiver=None, giver=["replay", "hesitant"], scenes=None, n_scenes=1)
    assert report.policies == ("replay", "hesitant")
    assert report.scores.shape == (2, 1, 1)
    assert "Giver replay, hesitant with 1 receivers" in str(report)


def change(report: StrangersReport, **changes: Any) -> StrangersReport:
    """Return a report with other metadata or other episodes of all pairs."""
    fields = {key: changes.pop(key) for key in list(changes) if key in ("fingerprint", "models", "n_objects")}
    pairs = {
        key: replace(
            pair,
            metadata=replace(pair.metadata, **changes),
            episodes=tuple(replace(episode, **fields) for episode in pair.episodes),
        )
        for key, pair in report.reports.items()
    }
    return replace(report, reports=pairs)


def make_changed_leaderboard(
    monkeypatch: pytest.MonkeyPatch, evaluated: Path, population: Path, **changes: Any
) -> protocol.Leaderboard:
    """Make a leaderboard of an evaluation and the same one with changes."""
    reports = iter([read_report(evaluated), change(read_report(evaluated), **changes)])
    monkeypatch.setattr(protocol, "read_report", lambda path: next(reports))
    return make_leaderboard([evaluated, evaluated], population, names=["one", "other"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": "1"}, "seed"),
        ({"giver_hash": "other"}, "code of 'hurried"),
        ({"fingerprint": "other"}, "data"),
        ({"split": "test", "seed": "1"}, "seed"),
    ],
)
def test_evaluations_of_other_conditions_are_refused(
    monkeypatch: pytest.MonkeyPatch, evaluated: Path, population: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ResultsError, match=f"must have the {message}.* of the other folders"):
        make_changed_leaderboard(monkeypatch, evaluated, population, **changes)


def test_both_splits_of_a_method_are_side_by_side(
    monkeypatch: pytest.MonkeyPatch, evaluated: Path, population: Path
) -> None:
    reports = iter([change(read_report(evaluated), split=split) for split in ("val", "val", "test", "test")])
    monkeypatch.setattr(protocol, "read_report", lambda path: next(reports))
    table = make_leaderboard([evaluated] * 4, population, names=["one", "other", "other", "one"])
    scores, differences, families = table.build_tables()
    assert [row[:2] for row in scores.rows] == [["one", "val"], ["one", "test"], ["other", "val"], ["other", "test"]]
    assert [row[:3] for row in differences.rows] == [["one", "other", "val"], ["one", "other", "test"]]
    assert families.header[1:3] == ["one, val: success %", "one, test: success %"]
    assert "2 scenes of val and 2 scenes of test each, fast physics, seed 0" in str(table)


def test_the_same_policy_is_no_second_training(
    fake_data: Path, evaluated: Path, population: Path, tmp_path: Path
) -> None:
    copies = [shutil.copy(POPULATION_FOLDER / "receiver_replay.npz", tmp_path / f"{name}.npz") for name in "ab"]
    with pytest.raises(OptionError, match="receiver must name different policies, got two"):
        run(fake_data, population, receiver=[f"learned:{copy}" for copy in copies])
    out = tmp_path / "out"
    shutil.copytree(evaluated, out)
    content = json.loads((out / "strangers.json").read_text())
    (out / "strangers.json").write_text(json.dumps(content | {"policies": ["hold", "hold"]}))
    with pytest.raises(ResultsError, match="must have different policies"):
        read_report(out)


@pytest.mark.slow
def test_leaderboard(
    fake_data: Path, population: Path, evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    shutil.copytree(evaluated, other)
    with pytest.raises(OptionError, match="must have one evaluation of 'hold' with the split val, got"):
        make_leaderboard([evaluated, other], population)
    named = ["strangers-table", f"one={evaluated}", f"another={other}", "--population", str(population)]
    picture = tmp_path / "heat_map.png"
    assert main([*named, "--heat-map", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "| one     | val   | 1         | panda | 0." in printed
    assert "| one    | another | val   |" in printed
    # Without stored references there is no score relative to the best of the methods.
    assert "No BR-Prox: a partner has no reference" in printed
    assert picture.read_bytes().startswith(b"\x89PNG")
    references = tmp_path / "references.json"
    update_references([evaluated], population, references)
    assert main([*named, "--references", str(references)]) == 0
    printed = capsys.readouterr().out
    assert "AS of the best policy known" in printed
    assert "No BR-Prox" not in printed
    assert main([*named, "--references", str(tmp_path / "absent.json")]) == 2
    assert "references must be a file that" in capsys.readouterr().err
    assert main([*named[:2], str(other), *named[3:]]) == 2
    assert "must all have names, or none" in capsys.readouterr().err
    for pair in json.loads((other / "strangers.json").read_text())["folders"]["hold"].values():
        next((other / pair).glob("*.npz")).unlink()
    with pytest.raises(ResultsError, match="must have the data and scenes of the other folders"):
        make_leaderboard([evaluated, other], population, names=["one", "other"])
    with pytest.raises(OptionError, match="must be of population"):
        make_leaderboard([evaluated], write_population(tmp_path, version="2.0"))
    with pytest.raises(OptionError, match="at least one folder"):
        make_leaderboard([])


def test_incomplete_folders_are_refused(population: Path, evaluated: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(evaluated, out)
    content = json.loads((out / "strangers.json").read_text())
    folder = out / content["folders"]["hold"]["fast"]
    next(folder.glob("*.npz")).unlink()
    with pytest.raises(ResultsError, match="must have the scenes and data of the other pairs"):
        make_leaderboard([out], population)
    shutil.rmtree(folder)
    with pytest.raises(ResultsError, match="does not exist"):
        make_leaderboard([out], population)
    # Results of one partner are in the folder of another one.
    shutil.copytree(out / content["folders"]["hold"]["slow"], folder)
    with pytest.raises(ResultsError, match="must have results of 'fast' of the population"):
        make_leaderboard([out], population)
    (out / "strangers.json").write_text(json.dumps(content | {"partners": content["partners"][1:]}))
    with pytest.raises(ResultsError, match="must have the partners of 'test', got others"):
        make_leaderboard([out], population)
    content["folders"]["hold"]["fast"] = "../other"
    (out / "strangers.json").write_text(json.dumps(content))
    with pytest.raises(ResultsError, match="not a readable evaluation"):
        make_leaderboard([out], population)
    with pytest.raises(ResultsError, match="is not finished"):
        make_leaderboard([tmp_path], population)


def test_arguments(fake_data: Path, population: Path) -> None:
    for options, message in (
        ({"giver": "replay"}, "exactly one of receiver and giver"),
        ({"receiver": None}, "exactly one of receiver and giver"),
        ({"shard": "1/2"}, "shard must be left out"),
        ({"world_config": WorldConfig(initial_joint_noise=0.1)}, "must be the official one for strangers"),
        ({"scenes": None, "n_scenes": 0}, "number of scenes must be a whole number of at least 1"),
    ):
        with pytest.raises(OptionError, match=message):
            run(fake_data, population, **options)
