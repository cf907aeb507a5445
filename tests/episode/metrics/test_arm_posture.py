"""Tests of the RULA scores of the giver's arm for postures with known scores."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from handover_marl.episode.metrics.fluency import (
    CHEST,
    FOREARM,
    HALF_SHOULDER_WIDTH,
    UPPER_ARM,
    _pose_arm,
    compute_rula_arm_scores,
)

SHOULDER, UPPER = np.add(CHEST, [HALF_SHOULDER_WIDTH, 0.0, 0.0]), UPPER_ARM  # the left one
WRISTS = arrays(np.float64, (3,), elements=st.floats(-1.0, 1.0))


def score(reach: list[float]) -> int:
    """Return the score of a left arm for a wrist at a vector from the shoulder (m)."""
    return int(compute_rula_arm_scores(SHOULDER[None] + np.array([reach]), "left")[0])


@pytest.mark.parametrize(
    ("reach", "upper", "forearm"),
    [
        ([-1e-6, 0.0, -UPPER - FOREARM], 1, 2),  # the arm hangs straight
        ([-1e-6, -FOREARM, -UPPER], 1, 1),  # the forearm is horizontal and points forward
        ([-1e-6, -0.6, -0.2], 3, 2),  # out of reach, the arm is straight and raised by 72 degrees
        ([-1e-6, -0.3, 0.5], 4, 2),  # the arm is straight and raised by 149 degrees
        ([-1e-6, 0.3, -0.5], 2, 2),  # the arm points back by 31 degrees
        ([FOREARM, 0.0, -UPPER], 1, 2),  # the forearm is bent, but out to the side
        ([-2.0 * HALF_SHOULDER_WIDTH, -0.25, -0.1], 3, 3),  # the wrist is past the midline, the arm straight
        ([0.5, -0.1, -0.1], 4, 3),  # straight out to the side: raised by 79 degrees, abducted
    ],
)
def test_scores_of_known_postures(reach: list[float], upper: int, forearm: int) -> None:
    assert score(reach) == upper + forearm


@given(WRISTS)
def test_the_arm_has_its_lengths_and_ends_at_the_wrist(reach: np.ndarray) -> None:
    upper, flexion = _pose_arm(reach[None])
    length = np.linalg.norm(reach)
    assert np.linalg.norm(upper[0]) == pytest.approx(1.0)
    assert 0.0 <= flexion[0] <= 180.0
    if UPPER - FOREARM + 1e-3 < length < UPPER + FOREARM - 1e-3:
        forearm = reach - UPPER * upper[0]
        assert np.linalg.norm(forearm) == pytest.approx(FOREARM, abs=1e-6)
        cosine = (forearm @ upper[0]) / FOREARM
        assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) == pytest.approx(flexion[0], abs=1e-3)


@given(WRISTS)
def test_both_sides_have_the_same_scores(reach: np.ndarray) -> None:
    mirrored = reach * [-1.0, 1.0, 1.0]
    left, right = (
        compute_rula_arm_scores(np.array(CHEST) + wrist[None], side)[0]
        for wrist, side in ((reach, "left"), (mirrored, "right"))
    )
    assert left == right
    assert 2 <= left <= 8
