"""Tests of reading `config.yaml` of result folders, also if it is malformed or was written by HandoverSim."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from handover_marl.config import OFFICIAL_CONFIG, ProtocolConfig, WorldConfig
from handover_marl.errors import ResultsError
from handover_marl.evaluation.metadata import (
    ResultMetadata,
    format_config,
    format_world_label,
    parse_world_label,
    read_result_metadata,
)
from handover_marl.evaluation.reports.report import evaluate
from handover_marl.evaluation.results import ResultFolder

SETTINGS = ResultMetadata("s0", "test", "hold", "replay", "exact", "dexycb", "1.0")


@pytest.fixture
def folder(tmp_path: Path) -> ResultFolder:
    return ResultFolder(tmp_path, SETTINGS)


def change_config(path: Path, section: str, value: object) -> None:
    config = yaml.safe_load((path / "config.yaml").read_text())
    config[section] = {**config[section], **value} if isinstance(value, dict) else value
    (path / "config.yaml").write_text(yaml.safe_dump(config))


@pytest.mark.parametrize(
    ("section", "key", "value", "fault"),
    [
        *(
            ("BENCHMARK", key, value, f"(unknown|) ?{key.lower()}")
            for key in ("SETUP", "SPLIT")
            for value in ("s9", None)
        ),
        *(("HANDOVER_MARL", "receiver", value, "receiver must be text") for value in (3, "\x1b[2J", "x" * 30_000)),
        ("HANDOVER_MARL", "physics", "bullet", "unknown physics 'bullet'; valid: exact, fast, mujoco"),
        ("HANDOVER_MARL", "robot", "ur5", "unknown robot 'ur5'"),
    ],
)
def test_impossible_values_are_refused(folder: ResultFolder, section: str, key: str, value: object, fault: str) -> None:
    change_config(folder.path, section, {key: value})
    with pytest.raises(ResultsError, match=rf"config\.yaml: {fault}"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize("text", ["", "[1]", "x: [", "SIM: [1]", "[" * 5000])
def test_malformed_configurations(folder: ResultFolder, text: str) -> None:
    (folder.path / "config.yaml").write_text(text)
    with pytest.raises(ResultsError, match=r"config\.yaml: not a readable configuration"):
        read_result_metadata(folder.path)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("BENCHMARK", "GOAL_RADIUS", 9.0),
        ("BENCHMARK", "GOAL_RADIUS", "0.15"),
        ("BENCHMARK", "GOAL_CENTER", [0.61, -0.2, 1.0]),
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
    ResultFolder(tmp_path, settings, format_config(settings, config))
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["BENCHMARK"]["GOAL_RADIUS"] == 9.0
    assert read_result_metadata(tmp_path) == settings
    assert settings.world != "official" == format_world_label(OFFICIAL_CONFIG)
    # Other rules may not be declared as the official ones.
    change_config(tmp_path, "HANDOVER_MARL", {"world": "official"})
    with pytest.raises(ResultsError, match=r"GOAL_RADIUS is 9\.0"):
        read_result_metadata(tmp_path)


def test_a_label_states_the_noise_of_the_start() -> None:
    noise = 1 / 3 - 0.1
    config = WorldConfig(initial_joint_noise=noise)
    label = format_world_label(config)
    assert label == f"initial_joint_noise={noise!r}"
    assert parse_world_label(label) == config
    rules = ProtocolConfig(goal_radius=9.0)
    without_noise = format_world_label(WorldConfig(protocol=rules))
    assert format_world_label(replace(config, protocol=rules)) == f"{without_noise} {label}"


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
