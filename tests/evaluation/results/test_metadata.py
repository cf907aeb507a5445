"""Tests of reading `config.yaml` of result folders, also if it is malformed or was written by HandoverSim."""

import json
import os
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest
import yaml

from handover_marl.config import OFFICIAL_CONFIG, ProtocolConfig, WorldConfig
from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.results.metadata import (
    ResultMetadata,
    format_config,
    format_world_label,
    parse_world_label,
    read_result_metadata,
)
from handover_marl.evaluation.results.result_folder import ResultFolder
from tests.evaluation.deadline import ends_within

SETTINGS = ResultMetadata("s0", "test", "hold", "replay", "exact", "dexycb", "1.0")


@pytest.fixture
def folder(tmp_path: Path) -> ResultFolder:
    return ResultFolder(tmp_path, SETTINGS)


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
    with pytest.raises(ResultsError, match=rf"config\.yaml: (unknown {key.lower()}|{key.lower()} must be text)"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize("key", ["receiver", "giver", "physics", "dataset", "version"])
@pytest.mark.parametrize("value", [3, None, ["hold"], 1.5, True, "\x1b[2J", "a\nb", "\x00"])
def test_values_of_the_library_section_are_text(folder: ResultFolder, key: str, value: object) -> None:
    change_config(folder.path, "HANDOVER_MARL", {key: value})
    with pytest.raises(ResultsError, match=rf"config\.yaml: {key} .*must be text"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("physics", "bullet", "unknown physics 'bullet'; valid: exact, fast, mujoco"),
        ("robot", "ur5", "unknown robot 'ur5'"),
        ("obs_mode", "tactile", "unknown obs_mode 'tactile'"),
        ("receiver", "x" * 30_000, "receiver must be text.* at most 20000 characters"),
    ],
)
def test_unknown_choices_and_long_names(folder: ResultFolder, key: str, value: str, fault: str) -> None:
    change_config(folder.path, "HANDOVER_MARL", {key: value})
    with pytest.raises(ResultsError, match=rf"config\.yaml: {fault}"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize("value", [[1], "text", 3, {"colour": "red"}, {"setup": "s0"}, {3: "x"}])
def test_malformed_library_sections(folder: ResultFolder, value: object) -> None:
    change_config(folder.path, "HANDOVER_MARL", value)
    with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize("text", ["", "3", "[1]", "x: [", "BENCHMARK: 2020-99-99", "[" * 5000])
def test_malformed_configurations(folder: ResultFolder, text: str) -> None:
    (folder.path / "config.yaml").write_text(text)
    with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
        read_result_metadata(folder.path)


def json_like(value: object) -> str:
    """Format a value as YAML on one line, with integers as hexadecimal numbers."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json_like(key)}: {json_like(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(json_like, value)) + "]"
    return hex(value) if isinstance(value, int) else str(value) if isinstance(value, date) else json.dumps(value)


@pytest.mark.parametrize(
    "text",
    [
        f"HANDOVER_MARL: 0x{'f' * 5000}",
        f"HANDOVER_MARL: {{receiver: 0x{'f' * 5000}}}",
        f"HANDOVER_MARL: {{receiver: [0x{'f' * 5000}]}}",
        f"BENCHMARK: {{SETUP: 0x{'f' * 5000}}}",
        f"BENCHMARK: {{GOAL_RADIUS: 0x{'f' * 5000}}}",
        f"BENCHMARK: {{GOAL_CENTER: [0x{'f' * 5000}]}}",
        "BENCHMARK: {GOAL_CENTER: {1: 2}}",
        "BENCHMARK: {GOAL_RADIUS: 2001-01-01}",
        "SIM: [1]",
        "SIM: text",
        "SIM: 3",
        "SIM: {TIME_STEP: [0.001]}",
    ],
)
def test_long_values_are_shortened_in_errors(folder: ResultFolder, text: str) -> None:
    config = yaml.safe_load((folder.path / "config.yaml").read_text())
    ((section, value),) = yaml.safe_load(text).items()
    config[section] = {**config[section], **value} if isinstance(value, dict) else value
    # safe_dump would write integers as decimal numbers, which Python refuses for so many digits.
    lines = [f"{name}: {json_like(part)}" for name, part in config.items()]
    (folder.path / "config.yaml").write_text("\n".join(lines))
    with pytest.raises(ResultsError, match=r"config\.yaml"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("BENCHMARK", "GOAL_RADIUS", 9.0),
        ("BENCHMARK", "GOAL_RADIUS", None),
        ("BENCHMARK", "GOAL_RADIUS", "0.15"),
        ("BENCHMARK", "GOAL_CENTER", [0.61, -0.2, 1.0]),
        ("BENCHMARK", "GOAL_CENTER", 1.25),
        ("BENCHMARK", "SUCCESS_TIME_THRESH", 0.0),
        ("BENCHMARK", "MAX_EPISODE_TIME", 130.0),
        ("SIM", "TIME_STEP", 0.01),
    ],
)
@pytest.mark.parametrize("own", [True, False])
def test_other_rules_are_not_official_results(
    folder: ResultFolder, section: str, key: str, value: object, own: bool
) -> None:
    """Results under other rules are refused, because reports would compare them with published figures."""
    (folder.path / "000.npz").write_bytes(b"not looked at")
    change_config(folder.path, section, {key: value})
    if not own:
        change_config(folder.path, "HANDOVER_MARL", None)
    message = rf"config\.yaml: {key} is .*official rules say"
    with pytest.raises(ResultsError, match=message):
        evaluate(folder.path)
    with pytest.raises(ResultsError, match=message):
        ResultFolder(folder.path, SETTINGS)
    assert yaml.safe_load((folder.path / "config.yaml").read_text())[section][key] == value


def test_a_folder_stores_its_rules(tmp_path: Path) -> None:
    config = WorldConfig(protocol=ProtocolConfig(goal_radius=9.0))
    settings = ResultMetadata(
        "s0", "test", "hold", "replay", "exact", "dexycb", "1.0", world=format_world_label(config)
    )
    ResultFolder(tmp_path, settings, config)
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["BENCHMARK"]["GOAL_RADIUS"] == 9.0
    assert read_result_metadata(tmp_path) == settings
    assert settings.world != "official" == format_world_label(OFFICIAL_CONFIG)
    # Other rules may not be declared as the official ones.
    change_config(tmp_path, "HANDOVER_MARL", {"world": "official"})
    with pytest.raises(ResultsError, match=r"GOAL_RADIUS is 9\.0"):
        read_result_metadata(tmp_path)


@pytest.mark.parametrize("noise", [0.001, 1 / 3 - 0.1])
def test_a_label_states_the_noise_of_the_start(noise: float) -> None:
    config = WorldConfig(initial_joint_noise=noise)
    label = format_world_label(config)
    assert label == f"initial_joint_noise={noise!r}"
    assert parse_world_label(label) == config
    rules = ProtocolConfig(goal_radius=9.0)
    without_noise = format_world_label(WorldConfig(protocol=rules))
    assert format_world_label(replace(config, protocol=rules)) == f"{without_noise} {label}"


REST = "giver: replay, physics: exact, dataset: dexycb, version: '1.0'"


def bomb(levels: int) -> str:
    """Return a few lines of YAML whose aliases expand to 10^levels numbers."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, levels)]
    return "\n".join(lines) + f"\nHANDOVER_MARL: {{receiver: *a{levels - 1}, {REST}}}\n"


@pytest.mark.parametrize(
    "text",
    [
        bomb(7),
        "GOAL_CENTER: &a [*a]",
        f"HANDOVER_MARL: &a {{receiver: *a, {REST}}}",
        "x: &a\n  <<: *a",
        "[" * 5_000,
        "[\n" * 5_000,
        "? " * 5_000,
    ],
)
def test_alias_and_nesting_bombs_are_refused(folder: ResultFolder, text: str) -> None:
    path = folder.path / "config.yaml"
    content = yaml.safe_load(path.read_text())
    text += f"\nBENCHMARK: {content['BENCHMARK']}\n" if text[0] not in "[?" else ""
    path.write_text(text)
    with ends_within(20.0):
        for read in (read_result_metadata, evaluate, lambda path: ResultFolder(path, SETTINGS)):
            with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration") as caught:
                read(folder.path)
            assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "text",
    [
        "[" * 900_000,
        "x: 1" + ":1" * 450_000,
        "- 1\n" * 200_000,
        "x: {" + "a: 1, " * 120_000 + "}",
        "x" * 2_000_000,
        "# " * 1_000_000,
    ],
    ids=["brackets", "to the base of sixty", "list", "mapping", "text", "comments"],
)
def test_long_configurations_are_refused(folder: ResultFolder, text: str) -> None:
    """Configurations of 700 kB and more are refused; those of HandoverSim have a few thousand bytes."""
    (folder.path / "config.yaml").write_text(text)
    with ends_within(5.0), pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
        evaluate(folder.path)


def test_named_pipes_are_not_opened_as_configurations(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "config.yaml")
    with ends_within(5.0):
        for read in (read_result_metadata, evaluate, lambda path: ResultFolder(path, SETTINGS)):
            with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
                read(tmp_path)
    assert (tmp_path / "config.yaml").is_fifo()


def test_metadata_are_read_as_written(tmp_path: Path) -> None:
    settings = ResultMetadata("s3", "val", "omg:wait=1.5", "learned: {x}", "fast", "no", "1e5", "12345678", "0", "-1")
    (tmp_path / "config.yaml").write_text(format_config(settings, OFFICIAL_CONFIG))
    assert read_result_metadata(tmp_path) == settings


@pytest.mark.parametrize(
    ("env", "robot", "obs_mode"),
    [
        ({"ID": "HandoverHandCameraPointStateEnv-v1"}, "panda_camera", "state+pointcloud"),
        ({"ID": "HandoverStateEnv-v1"}, "panda", "state"),
        ({}, "panda", "state"),
    ],
)
def test_robot_of_folders_of_the_original_code(tmp_path: Path, env: dict[str, str], robot: str, obs_mode: str) -> None:
    content = {"BENCHMARK": {"SETUP": "s0", "SPLIT": "test"}, "ENV": env}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(content))
    settings = read_result_metadata(tmp_path)
    assert (settings.robot, settings.obs_mode, settings.wait_s) == (robot, obs_mode, "")


def test_a_folder_of_result_folders_names_them(tmp_path: Path) -> None:
    ResultFolder(tmp_path / "replay-hold", SETTINGS)
    ResultFolder(tmp_path / "cooperative-hold", SETTINGS)
    with pytest.raises(ResultsError, match=r"no config\.yaml; pass one of its folders cooperative-hold, replay-hold"):
        read_result_metadata(tmp_path)
