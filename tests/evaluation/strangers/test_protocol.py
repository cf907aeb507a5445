"""Tests of the evaluation with the partners of a population, with policies that take little time."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.config import WorldConfig
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.strangers.leaderboard import make_leaderboard
from handover_marl.evaluation.strangers.reference_update import update_references
from handover_marl.evaluation.strangers.report import StrangersReport
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


def test_report_and_files(fake_data: Path, population: Path, evaluated: Path, tmp_path: Path) -> None:
    content = json.loads((evaluated / "strangers.json").read_text())
    assert content["summary"]["success"]["value"] == 0.0
    assert content["results"]["slow"]["AS"] == 0.0
    assert str(population.parent) not in (evaluated / "strangers.json").read_text()
    text = (evaluated / "strangers.md").read_text()
    assert "Receiver hold with 2 givers of small 1.0" in text
    assert "fast physics" in text
    assert "No references" in text
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
    rows = summary.build_tables()[0].rows
    assert [row[0] for row in rows] == ["fast", "slow"]
    assert [row[3] for row in rows] == ["hold", "hold"]
    command = next(iter(summary.table.sections.values()))["fast"].command
    assert command.startswith("handover-marl pair --giver hurried:min_rate=0.5,max_rate=0.6 --receiver hold --dataset ")
    assert "--physics fast --robot panda --seed 0 --scenes " in command
    shutil.copytree(evaluated, out)
    found = run(fake_data, population, out=out)
    assert found.references is not None
    (out / "strangers.json").unlink()
    both = update_references([out], population, tmp_path / "both.json")
    assert [row[0] for row in both.build_tables()[0].rows] == ["fast", "slow", "still"]
    # The reference scores of both partners are zero, so that every score counts as having reached them.
    assert found.estimate_all()["br_prox"].value == 1.0


def test_evenly_spaced_scenes_and_receivers_as_partners(fake_data: Path, population: Path) -> None:
    report = run(fake_data, population, receiver=None, giver=["replay", "hesitant"], scenes=None, n_scenes=1)
    assert report.policies == ("replay", "hesitant")
    assert report.scores.shape == (2, 1, 1)
    assert "Giver replay, hesitant with 1 receivers" in str(report)


def test_other_worlds_are_refused(fake_data: Path, population: Path) -> None:
    with pytest.raises(OptionError, match="must be the official one for strangers"):
        run(fake_data, population, world_config=WorldConfig(initial_joint_noise=0.1))


def test_leaderboard(
    fake_data: Path, population: Path, evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    shutil.copytree(evaluated, other)
    table = make_leaderboard([evaluated, other], population)
    assert [report.policies for report in table.reports] == [("hold",), ("hold",)]
    assert not table.has_stored_references
    picture = tmp_path / "heat_map.png"
    command = ["strangers-table", str(evaluated), str(other), "--population", str(population)]
    assert main([*command, "--heat-map", str(picture)]) == 0
    assert "the best of these methods" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
    references = tmp_path / "references.json"
    update_references([evaluated], population, references)
    named = ["strangers-table", f"one={evaluated}", f"another={other}", "--population", str(population)]
    assert main([*named, "--references", str(references)]) == 0
    printed = capsys.readouterr().out
    assert "| one     | 1         | panda | 0." in printed
    assert "| one    | another |" in printed
    assert "stored references" in printed
    assert main([*named, "--references", str(tmp_path / "absent.json")]) == 2
    assert "references must be a file that" in capsys.readouterr().err
    assert main([*named[:2], str(other), *named[3:]]) == 2
    assert "must have different names, all or none" in capsys.readouterr().err
    for pair in json.loads((other / "strangers.json").read_text())["folders"]["hold"].values():
        next((other / pair).glob("*.npz")).unlink()
    with pytest.raises(ResultsError, match="must have the same condition"):
        make_leaderboard([evaluated, other], population)
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
    with pytest.raises(ResultsError, match="must have the scenes of the other pairs"):
        make_leaderboard([out], population)
    shutil.rmtree(folder)
    with pytest.raises(ResultsError, match="does not exist"):
        make_leaderboard([out], population)
    # Results of one partner are in the folder of another one; then a partner is left out.
    shutil.copytree(out / content["folders"]["hold"]["slow"], folder)
    with pytest.raises(ResultsError, match="must have results of 'fast' of the population"):
        make_leaderboard([out], population)
    shortened = content | {"partners": content["partners"][1:]}
    (out / "strangers.json").write_text(json.dumps(shortened))
    with pytest.raises(ResultsError, match="must have the partners of 'test', got others"):
        make_leaderboard([out], population)
    for policies in ([5], [None], [["hold"]], "hold", 5):
        (out / "strangers.json").write_text(json.dumps(content | {"policies": policies}))
        with pytest.raises(ResultsError, match="not a readable evaluation"):
            make_leaderboard([out], population)
    content["folders"]["hold"]["fast"] = "../other"
    (out / "strangers.json").write_text(json.dumps(content))
    with pytest.raises(ResultsError, match="not a readable evaluation"):
        make_leaderboard([out], population)
    with pytest.raises(ResultsError, match="is not finished"):
        make_leaderboard([tmp_path], population)


def test_arguments(fake_data: Path, population: Path) -> None:
    with pytest.raises(OptionError, match="exactly one of receiver and giver"):
        run(fake_data, population, giver="replay")
    with pytest.raises(OptionError, match="exactly one of receiver and giver"):
        run(fake_data, population, receiver=None)
    with pytest.raises(OptionError, match="shard must be left out"):
        run(fake_data, population, shard="1/2")


def test_command(
    fake_data: Path, population: Path, evaluated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    shutil.copytree(evaluated, out)
    command = ["strangers", "--receiver", "hold", "--population", str(population), "--split", "val", "--scenes", "9,14"]
    command += ["--data-dir", str(fake_data), "--workers", "1", "--no-progress", "--format", "csv", "--out", str(out)]
    assert main(command) == 0
    output = capsys.readouterr()
    assert "fast,timing," in output.out
    assert "strangers.md" in output.err
    assert main(["strangers-references", str(tmp_path / "nothing"), "--population", str(population)]) == 2
    assert "must contain result folders" in capsys.readouterr().err
