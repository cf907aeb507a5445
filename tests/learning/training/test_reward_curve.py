"""Tests of the table of reward terms of a training."""

from pathlib import Path

import numpy as np
import pytest

from handover_marl.errors import ResultsError
from handover_marl.learning.training.reward_curve import RewardCurve, TermPoint


def test_means_over_episodes_are_written(tmp_path: Path) -> None:
    curve = RewardCurve(tmp_path / "reward_terms.csv")
    for value in (1.0, 2.0):
        curve.add_episode("receiver", {"return/near": value, "return": 9.0, "reward/near": 7.0, "steps": 3})
    curve.add_episode("giver", {"return/near": -1.0})
    assert curve.write_point(100) == {"receiver/near": 1.5, "giver/near": -1.0}
    assert curve.write_point(200) == {}
    curve.add_episode("receiver", {"return/near": 5.0})
    curve.write_point(300)
    assert (tmp_path / "reward_terms.csv").read_text().splitlines() == [
        "steps,agent,term,mean,episodes",
        "100,receiver,near,1.5,2",
        "100,giver,near,-1.0,1",
        "300,receiver,near,5.0,1",
    ]


def test_batches_of_transitions_hold_episodes(tmp_path: Path) -> None:
    curve = RewardCurve(tmp_path / "terms.csv")
    infos = {"return/a": np.array([[1.0], [2.0], [3.0]]), "return/b": np.zeros((3, 1)), "steps": np.zeros((3, 1))}
    curve.add_batch("giver", infos, np.array([True, False, True]))
    assert curve.write_point(1) == {"giver/a": 2.0, "giver/b": 0.0}


def test_a_resumed_run_continues_the_table(tmp_path: Path) -> None:
    path = tmp_path / "terms.csv"
    first = RewardCurve(path)
    for steps in (1, 2):
        first.add_episode("giver", {"return/a": float(steps)})
        first.write_point(steps)
    again = RewardCurve(path, resume=True)
    assert again.points == first.points == [TermPoint(step, "giver", "a", float(step), 1) for step in (1, 2)]
    again.discard_points_after(1)
    assert [point.steps for point in again.points] == [1]
    assert RewardCurve(path).points == []
    path.write_text("steps,agent\n1,giver\n")
    with pytest.raises(ResultsError, match="not a table of reward terms"):
        RewardCurve(path, resume=True)
