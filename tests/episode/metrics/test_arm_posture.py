"""Tests of the RULA scores of the giver's arm for postures with known scores."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from handover_marl.episode.metrics.fluency import compute_rula_arm_scores

#: Left shoulder, half the distance between the shoulders, and lengths of upper arm and forearm (m).
SHOULDER, HALF_SHOULDER_WIDTH, UPPER, FOREARM = np.array([0.786, 0.65, 1.35]), 0.226, 0.326, 0.256
WRISTS = arrays(np.float64, (3,), elements=st.floats(-1.0, 1.0))


def score(reach: list[float]) -> int:
    """Return the score of a left arm for a wrist at a vector from the shoulder (m)."""
    return int(compute_rula_arm_scores(SHOULDER[None] + np.array([reach]), "left")[0])


@pytest.mark.parametrize(
    ("reach", "upper", "forearm"),
    [
        ([-1e-6, 0.0, -UPPER - FOREARM], 1, 2),  # the arm hangs straight
        ([0.0, -FOREARM, -UPPER], 1, 1),  # the forearm is horizontal and points forward
        ([0.0, 0.0, -0.3], 2, 2),  # the wrist is below the shoulder, and the elbow behind by 48 degrees
        ([0.6, 0.0, -0.2], 4, 3),  # straight out to the side, neither forward nor back
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


@pytest.mark.parametrize(("raised", "lower", "higher"), [(20.0, 3, 4), (45.0, 4, 5), (90.0, 5, 6), (-20.0, 3, 4)])
def test_scores_increase_with_the_angle_of_a_straight_arm(raised: float, lower: int, higher: int) -> None:
    for degrees, expected in ((raised * 0.98, lower), (raised * 1.02, higher)):
        assert score([0.0, -np.sin(np.radians(degrees)), -np.cos(np.radians(degrees))]) == expected
    # Abduction adds 1, and a wrist beside the shoulder 1.
    if raised == 20.0:
        assert [score([np.sin(angle), 0.0, -np.cos(angle)]) for angle in np.radians([19.6, 20.4])] == [4, 6]


@pytest.mark.parametrize(("flexion", "expected"), [(59.5, 5), (60.5, 4), (99.5, 4), (100.5, 5)])
def test_forearms_bent_by_60_to_100_degrees_have_a_lower_score(flexion: float, expected: int) -> None:
    """The wrist is in front of the shoulder, so that the upper arm is raised by 45 to 90 degrees."""
    assert (
        score([0.0, -np.sqrt(UPPER**2 + FOREARM**2 + 2 * UPPER * FOREARM * np.cos(np.radians(flexion))), 0.0])
        == expected
    )


@given(WRISTS)
def test_both_sides_have_the_same_scores(reach: np.ndarray) -> None:
    mirrored = reach * [-1.0, 1.0, 1.0]
    left, right = (
        compute_rula_arm_scores(SHOULDER - [HALF_SHOULDER_WIDTH, 0.0, 0.0] + wrist[None], side)[0]
        for wrist, side in ((reach, "left"), (mirrored, "right"))
    )
    assert left == right
    assert 2 <= left <= 8
