"""Script that compares two ways to train a receiver."""

from pathlib import Path

import numpy as np
import pytest

from experiments.strangers.compare_trainings import Args, evaluate, main
from handover_marl import EpisodeStatus, evaluate_pair
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from tests.evaluation.strangers.populations import write_population

pytest.importorskip("mujoco", reason="needs MuJoCo")


def write(path: Path, slope: float, n_features: int = 12) -> Path:
    """Write a policy that closes the gripper where the proximity to the grasp (feature 6) exceeds 1 / slope."""
    weights = np.zeros((7, n_features), dtype=np.float32)
    weights[6, 6] = slope
    bias = np.zeros(7, dtype=np.float32)
    bias[6] = -0.5
    features = {12: "close", 48: "close_stack"}[n_features]
    write_policy(path, PolicySpec("receiver", features, "grasp_servo", 0.2), DenseNetwork((weights,), (bias,)))
    return path


def test_scores_are_those_of_single_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [write(tmp_path / f"{slope}.npz", slope) for slope in (1.5, 20.0)]
    args = Args(
        dataset="synthetic",
        setup="s0",
        first=tuple(files[:1]),
        second=tuple(files[1:]),
        population=str(write_population(tmp_path)),
        n_scenes=2,
        out=tmp_path / "scores.json",
    )
    scores, outcomes = evaluate(args)
    scenes = tuple(select_scenes_evenly(args.open_dataset().list_scenes("s0", "val"), 2))
    assert scores.shape == (2, 1, 2)
    assert scores.any()
    for number, file in enumerate(files):
        where = {"dataset": "synthetic", "physics": "mujoco", "workers": 1, "progress": False, "scenes": scenes}
        report = evaluate_pair("replay", f"learned:{file}", "s0", "val", **where)
        np.testing.assert_array_equal(scores[number, 0], [episode.speed_score for episode in report.episodes])
        drops = [bool(episode.status & EpisodeStatus.OBJECT_DROP) for episode in report.episodes]
        np.testing.assert_array_equal(outcomes["drop"][number, 0], drops)
    main(args)
    assert "AS, first minus second" in capsys.readouterr().out
    assert (tmp_path / "scores.json").is_file()


def test_files_of_one_way_with_different_features_are_refused(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a.npz", 1.5), write(tmp_path / "b.npz", 1.5, 48)
    with pytest.raises(OptionError, match="same features, actions and control period"):
        evaluate(Args(dataset="synthetic", setup="s0", first=(first, second), second=(second,)))


def test_ways_with_different_features(tmp_path: Path) -> None:
    population = str(write_population(tmp_path))
    first, second = write(tmp_path / "a.npz", 20.0), write(tmp_path / "b.npz", 20.0, 48)
    args = Args(dataset="synthetic", setup="s0", first=(first,), second=(second,), population=population, n_scenes=2)
    scores, _ = evaluate(args)
    # Both have the same weights of the present decision, and zeros for the earlier ones.
    np.testing.assert_array_equal(scores[0], scores[1])
