"""Tests that files written by version 0.7.0 can be read."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import handover_marl
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.crossplay import read_crossplay_pairs
from handover_marl.evaluation.results.metadata import read_result_metadata
from handover_marl.evaluation.results.result_folder import ResultFolder, encode_result
from handover_marl.evaluation.verification.folder_checks import check_reports
from handover_marl.policies.reference import parse_policy

OLD = Path(__file__).parents[1] / "data" / "v0_7_0"


@pytest.mark.parametrize(
    ("folder", "outcomes"),
    [
        ("benchmark", ["success", "success"]),
        ("pair", ["success", "success"]),
        ("vision", ["success"]),
        ("agreement/exact", ["timeout"]),
        ("agreement/fast", ["timeout"]),
        ("crossplay/replay-yang2021", ["drop", "contact"]),
    ],
)
def test_result_folders_are_evaluated(folder: str, outcomes: list[str]) -> None:
    report = handover_marl.evaluate(OLD / folder)
    assert [episode.status.label for episode in report.episodes] == outcomes
    assert report.metadata.version == "0.7.0"
    assert all(episode.fluency is not None for episode in report.episodes)


def test_metrics_of_a_result_folder() -> None:
    """The largest force is read from its old key, and metrics that version 0.7.0 did not compute are None."""
    found = handover_marl.evaluate(OLD / "benchmark").episodes[0].fluency
    assert found is not None
    assert found.max_robot_object_force == pytest.approx(593.8567745478858)
    assert found.reach == pytest.approx(0.4497887554653681)
    assert found.gripper_jerk is found.gripper_path is found.max_robot_hand_force is None


@pytest.mark.parametrize("folder", ["benchmark", "pair", "vision", "agreement/exact", "crossplay/replay-yang2021"])
def test_reports_agree_with_their_results(folder: str) -> None:
    assert check_reports(OLD / folder) == []


@pytest.mark.parametrize("key", ["plan_time", "peak_force", "exec"])
def test_forged_values_under_old_keys_are_found(key: str, tmp_path: Path) -> None:
    shutil.copytree(OLD / "benchmark", tmp_path, dirs_exist_ok=True)
    report = tmp_path / "report.json"
    text, n = re.subn(rf'("{key}": (?:{{\s*"mean": )?)(\d)', r"\g<1>9\g<2>", report.read_text())
    assert n
    report.write_text(text)
    assert check_reports(tmp_path)


def test_identity_of_a_result_folder() -> None:
    metadata = read_result_metadata(OLD / "benchmark")
    assert (metadata.receiver_hash, metadata.giver_hash) == ("93ba94f9", "d7b5edc9")
    assert (metadata.wait_s, metadata.obs_mode, metadata.camera) == ("3", "state", "")
    assert (metadata.recorded, metadata.missing_package) == ("", "")


def test_camera_of_a_result_folder() -> None:
    metadata = read_result_metadata(OLD / "vision")
    assert metadata.obs_mode == "pointcloud"
    assert metadata.camera.startswith("renderer rays, camera model handoversim, ")
    assert "depth_noise_std=0.0036" in metadata.camera


def test_old_and_new_folders_are_compared(tmp_path: Path) -> None:
    """Folders of both versions with equal metrics, other hashes of the data and one other outcome."""
    report = handover_marl.evaluate(OLD / "benchmark")
    new = ResultFolder(tmp_path, replace(report.metadata, version=handover_marl.__version__))
    for episode, status in zip(report.episodes, (EpisodeStatus.SUCCESS, EpisodeStatus.OBJECT_DROP), strict=True):
        result = replace(episode, status=status, fingerprint="of another version")
        new.write(result, encode_result(result, np.zeros((result.steps, 9), np.float32), np.zeros(result.steps)))
    comparison = handover_marl.compare(OLD / "benchmark", tmp_path)
    versions = [side.metadata.version for side in (comparison.first, comparison.second)]
    assert versions == ["0.7.0", handover_marl.__version__]
    assert [(one.index, other.index) for one, other in comparison.pairs] == [(0, 0), (1, 1)]
    assert [(one.status.label, other.status.label) for one, other in comparison.changes] == [("success", "drop")]
    assert all(one.fluency == other.fluency for one, other in comparison.pairs)


def test_pairs_of_a_cross_play() -> None:
    assert read_crossplay_pairs(OLD / "crossplay") == [
        ("replay", "hold"),
        ("replay", "yang2021"),
        ("cooperative", "hold"),
        ("cooperative", "yang2021"),
    ]


@pytest.mark.parametrize("agent", ["giver", "receiver"])
def test_policy_files_are_loaded(agent: str) -> None:
    policy = parse_policy(agent, f"learned:{OLD / 'policies' / agent}.npz").make()
    assert policy.label.startswith(f"learned:{agent}@")
