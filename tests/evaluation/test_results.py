"""Tests of result folders, of their `config.yaml`, and of episode files: written, read, and refused if impossible."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import handover_marl
from handover_marl.cli import main
from handover_marl.config import OFFICIAL_CONFIG, ProtocolConfig, WorldConfig
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.metadata import (
    ResultMetadata,
    format_config,
    format_world_label,
    parse_world_label,
    read_result_metadata,
)
from handover_marl.evaluation.reports.report import load_report
from handover_marl.evaluation.results import (
    EpisodeResult,
    ResultFolder,
    encode_result,
    format_episode_file,
    read_episode_file,
    read_results,
)
from tests.evaluation.quick import make_report, write_results

SETTINGS = ResultMetadata("s0", "test", "hold", "replay", "exact", "dexycb", "1.0")
OTHERS = [replace(SETTINGS, receiver="other"), replace(SETTINGS, seed="1"), replace(SETTINGS, receiver_hash="12345678")]
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


@pytest.fixture
def folder(tmp_path: Path) -> ResultFolder:
    """Return a folder with one result."""
    made = ResultFolder(tmp_path, SETTINGS)
    made.write(RESULT, encode_result(RESULT, np.zeros((50, 9), np.float32), np.full(50, 0.01)))
    return made


def test_results_are_read_as_written(folder: ResultFolder) -> None:
    assert read_result_metadata(folder.path) == SETTINGS
    [result] = read_results(folder.path)
    assert result.plan_s == pytest.approx(0.5)
    assert result == folder.read(0, "abc")
    assert {**vars(result), "plan_s": 0.5} == vars(RESULT)
    assert folder.read(1, "abc") is None
    change_config(folder.path, "HANDOVER_MARL", {"shard": "1/3"})
    assert read_result_metadata(folder.path) == SETTINGS, "older folders name their shard"


@pytest.mark.parametrize(
    "changes",
    [
        {"object_name": np.array(["a", "b"])},
        {"subject": 1.5},
        {"machine": "m" * 5_000_000},
        {"elapsed_time": np.full(50, np.nan)},
        {"scene_id": -1},
    ],
)
def test_impossible_results_are_refused(folder: ResultFolder, changes: dict[str, Any]) -> None:
    path = folder.path / "000.npz"
    with np.load(path) as archive:
        content = dict(archive)
    np.savez(path, **{**content, **changes})
    with pytest.raises(ResultsError, match=r"000\.npz"):
        read_results(folder.path)
    assert folder.read(0, "abc") is None


def test_more_steps_than_the_rules_allow_are_refused(folder: ResultFolder) -> None:
    result = replace(RESULT, status=EpisodeStatus.SUCCESS, steps=13_002)
    folder.write(result, encode_result(result, np.zeros((1, 9), np.float32), np.zeros(1)))
    with pytest.raises(ResultsError, match=r"000\.npz must have at most 13001 steps .*, got 13002"):
        load_report(folder.path)
    assert replace(result, steps=10**6).speed_score == 0.0


def test_results_in_the_wrong_place_are_refused(folder: ResultFolder) -> None:
    first, second = folder.path / "000.npz", folder.path / "001.npz"
    second.write_bytes(first.read_bytes())
    with pytest.raises(ResultsError, match=r"2 results are of scene 209; delete"):
        read_results(folder.path)
    first.unlink()
    with pytest.raises(ResultsError, match=r"001\.npz must be of scene 214, got scene 209; delete it"):
        load_report(folder.path)


def test_a_folder_belongs_to_its_first_evaluation(folder: ResultFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another evaluation is refused, also if the first one writes its configuration to the folder just before."""
    for other in OTHERS:
        with pytest.raises(ResultsError, match=r"holds another evaluation .*overwrite=True"):
            ResultFolder(folder.path, other)
    assert ResultFolder(folder.path, SETTINGS).read(0, "abc")
    sync, new = os.fsync, folder.path / "new"

    def sync_and_be_overtaken(handle: int) -> None:
        monkeypatch.setattr(os, "fsync", sync)
        ResultFolder(new, OTHERS[0])
        sync(handle)

    monkeypatch.setattr(os, "fsync", sync_and_be_overtaken)
    with pytest.raises(ResultsError, match="holds another evaluation"):
        ResultFolder(new, SETTINGS)
    assert read_result_metadata(new) == OTHERS[0]
    assert [path.name for path in new.iterdir()] == ["config.yaml"]


def test_fresh_deletes_only_results(folder: ResultFolder) -> None:
    path = folder.path
    for name in ("report.json", "report.md", "012.npz"):
        (path / name).write_text("old")
    others = ["agreement.md", "thesis.tex", "0000.npz", "policy.npz", "12.npz", ".hidden", "x001.npz", "exact/000.npz"]
    (path / "exact").mkdir()
    for name in others:
        (path / name).write_text("precious")
    ResultFolder(path, OTHERS[0], overwrite=True)
    assert read_result_metadata(path) == OTHERS[0]
    found = [entry.relative_to(path).as_posix() for entry in path.rglob("*") if entry.is_file()]
    assert sorted(found) == sorted([*others, "config.yaml"])
    assert all((path / name).read_text() == "precious" for name in others)


@pytest.mark.parametrize("content", ["model: resnet\nlearning_rate: 0.1\n", "BENCHMARK: 3", None])
def test_fresh_leaves_foreign_folders_unchanged(tmp_path: Path, content: str | None) -> None:
    """A folder of another program, even with a `config.yaml`, is refused and not changed."""
    if content is not None:
        (tmp_path / "config.yaml").write_text(content)
    (tmp_path / "000.npz").write_text("precious")
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    for overwrite in (False, True):
        with pytest.raises(ResultsError, match=r"config\.yaml"):
            ResultFolder(tmp_path, SETTINGS, overwrite=overwrite)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before


def change_config(path: Path, section: str, value: object) -> None:
    config = yaml.safe_load((path / "config.yaml").read_text())
    config[section] = {**config[section], **value} if isinstance(value, dict) else value
    (path / "config.yaml").write_text(yaml.safe_dump(config))


@pytest.mark.parametrize(
    ("section", "key", "value", "fault"),
    [
        ("BENCHMARK", "SETUP", "s9", "unknown setup"),
        ("BENCHMARK", "SPLIT", None, "split must be text"),
        ("HANDOVER_MARL", "receiver", "\x1b[2J", "receiver must be text"),
        ("HANDOVER_MARL", "physics", "bullet", "unknown physics 'bullet'; valid: exact, fast, mujoco"),
        ("HANDOVER_MARL", "robot", "ur5", "unknown robot 'ur5'"),
        # Reports would compare results under other rules with published figures.
        ("BENCHMARK", "GOAL_RADIUS", 9.0, "GOAL_RADIUS is .*official rules say"),
        ("SIM", "TIME_STEP", 0.01, "TIME_STEP is .*official rules say"),
    ],
)
def test_impossible_configurations(folder: ResultFolder, section: str, key: str, value: object, fault: str) -> None:
    change_config(folder.path, section, {key: value})
    for read in (load_report, lambda path: ResultFolder(path, SETTINGS)):
        with pytest.raises(ResultsError, match=rf"config\.yaml: {fault}"):
            read(folder.path)
    change_config(folder.path, "HANDOVER_MARL", None)  # as HandoverSim writes it
    if section != "HANDOVER_MARL":
        with pytest.raises(ResultsError, match=rf"config\.yaml: {fault}"):
            load_report(folder.path)


@pytest.mark.parametrize("text", ["", "[1]", "x: [", "SIM: [1]"])
def test_malformed_configurations(folder: ResultFolder, text: str) -> None:
    (folder.path / "config.yaml").write_text(text)
    with pytest.raises(ResultsError, match=r"config\.yaml: not a configuration of results"):
        read_result_metadata(folder.path)


def test_a_folder_stores_its_rules(tmp_path: Path) -> None:
    config = WorldConfig(protocol=ProtocolConfig(goal_radius=9.0))
    settings = replace(SETTINGS, world=format_world_label(config))
    ResultFolder(tmp_path, settings, format_config(settings, config))
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["BENCHMARK"]["GOAL_RADIUS"] == 9.0
    assert read_result_metadata(tmp_path) == settings
    assert settings.world != "official" == format_world_label(OFFICIAL_CONFIG)
    # Other rules may not be declared as the official ones.
    change_config(tmp_path, "HANDOVER_MARL", {"world": "official"})
    with pytest.raises(ResultsError, match=r"GOAL_RADIUS is 9\.0"):
        read_result_metadata(tmp_path)
    noisy = WorldConfig(initial_joint_noise=1 / 3 - 0.1)
    label = format_world_label(noisy)
    assert label == f"initial_joint_noise={1 / 3 - 0.1!r}"
    assert parse_world_label(label) == noisy
    assert format_world_label(replace(config, initial_joint_noise=1 / 3 - 0.1)) == f"{settings.world} {label}"


@pytest.mark.parametrize(
    ("env", "robot", "obs_mode"),
    [({"ID": "HandoverHandCameraPointStateEnv-v1"}, "panda_camera", "state+pointcloud"), ({}, "panda", "state")],
)
def test_robot_of_folders_of_the_original_code(tmp_path: Path, env: dict[str, str], robot: str, obs_mode: str) -> None:
    content = {"BENCHMARK": {"SETUP": "s0", "SPLIT": "test"}, "ENV": env}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(content))
    settings = read_result_metadata(tmp_path)
    assert (settings.robot, settings.obs_mode, settings.wait_s) == (robot, obs_mode, "")


def test_a_folder_of_result_folders_names_them(tmp_path: Path) -> None:
    for name in ("replay-hold", "cooperative-hold"):
        ResultFolder(tmp_path / name, SETTINGS)
    with pytest.raises(ResultsError, match=r"no config\.yaml; pass one of its folders cooperative-hold, replay-hold"):
        read_result_metadata(tmp_path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return the episode file of `make_report`, with other metrics of the first episode."""
    report, path = make_report(), tmp_path / "a.json"
    first, second = report.episodes
    assert first.fluency is not None
    moved = replace(first, fluency=replace(first.fluency, reach=first.fluency.reach + 0.25, min_distance=None))
    path.write_text(format_episode_file(report.metadata, (moved, second)))
    return path


def test_episode_files_hold_what_the_folder_holds(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_results(tmp_path / "folder")
    report, (metadata, stored) = handover_marl.load_report(folder), read_episode_file(file)
    assert metadata == report.metadata
    for found, true in zip(stored, report.episodes, strict=True):
        assert replace(found, plan_s=0.0, fluency=None) == replace(true, plan_s=0.0, fluency=None)
        assert found.plan_s == pytest.approx(true.plan_s, abs=6e-5)
    metrics, expected = (
        {key: np.nan if value is None else value for key, value in vars(episodes[1].fluency).items()}
        for episodes in (stored, report.episodes)
    )
    assert metrics == pytest.approx(expected, rel=6e-4, nan_ok=True)
    rows = {row[0]: row[1:] for row in handover_marl.compare(file, folder).build_tables()[-1].rows}
    assert float(str(rows["reach m"][0])) == 0.125, "the mean of 0.25 m and 0"
    assert rows["min distance cm"][2] == 1, "only one scene has a value in both"
    assert main(["compare", str(file), str(folder)]) == main(["report", str(file)]) == 0
    assert "| reach m " in capsys.readouterr().out
    assert main(["report", str(file), str(folder), "--format", "csv", "--columns", "receiver", "success %"]) == 0
    assert capsys.readouterr().out.count("50.0 (9.5 to 90.5)") == 2
    assert main(["report", str(file), str(folder), "--out", "page.html"]) == 2


def change(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update({key: value})


def change_row(column: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content["episodes"][0].__setitem__(content["columns"].index(column), value)


@pytest.mark.parametrize(
    "spoil",
    [
        change("metadata", {}),
        change("common", {"outcome": "triumph"}),
        change_row("index", 1),
        change_row("scene_id", 3),
        change_row("reach", "far"),
        lambda content: content["metadata"].update(split="all"),
        lambda content: content["common"].update(machine="\x1b[31mred"),
    ],
)
def test_impossible_episode_files_are_refused(spoil: Callable[[dict[str, Any]], None], file: Path) -> None:
    content = json.loads(file.read_text())
    spoil(content)
    file.write_text(json.dumps(content))
    with pytest.raises(ResultsError, match=r"a\.json"):
        handover_marl.load_report(file)
