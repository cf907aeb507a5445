"""How the reactive receiver's grasps have an object between the pads, and displaced ones."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from handover_marl.planning.gripper_room import Balls, rooms
from handover_marl.receivers.reactive.displaced import Displacements, displaced
from handover_marl.receivers.reactive.grasps import TriedGrasps
from handover_marl.receivers.reactive.grips import grips, spread_points

TIP = 0.1126  # m, of the fingers before the hand's frame
HALVES = np.array([0.05, 0.02, 0.05])
BOX = trimesh.creation.box(extents=2.0 * HALVES)
POINTS = spread_points(np.array(BOX.vertices), np.array(BOX.faces), 4000)
FAR = Balls(np.array([[1.0, 0.0, 0.0]]), np.array([0.01]))


def from_above(overlap: float, aside: float = 0.0) -> np.ndarray:
    """(7,) the hand over the box with its fingers so far beside it (m), and so far to the side of its middle (m)."""
    down = Rotation.from_euler("x", np.pi)
    return np.array([aside, 0.0, HALVES[2] + TIP - overlap, *down.as_quat()])


@pytest.mark.parametrize(
    ("overlap", "aside", "inside"),
    [
        (0.015, 0.0, 0.015),  # well on the pads
        (0.003, 0.0, 0.003),  # by the tips
        (0.030, 0.055, 0.011),  # by the edges, which count twice
        (-0.002, 0.0, 0.0),  # before the tips
    ],
)
def test_grips(overlap: float, aside: float, inside: float) -> None:
    assert grips(from_above(overlap, aside)[None], POINTS)[0] == pytest.approx(inside, abs=2.5e-3)


def test_the_worse_finger_counts() -> None:
    step = POINTS[(POINTS[:, 1] < 0.0) | (POINTS[:, 2] < HALVES[2] - 0.008)]
    for points in (step, step * np.array([1.0, -1.0, 1.0])):
        assert grips(from_above(0.012)[None], points)[0] == pytest.approx(0.004, abs=2e-3)


def test_points_spread_evenly_and_repeat() -> None:
    np.testing.assert_array_equal(POINTS, spread_points(np.array(BOX.vertices), np.array(BOX.faces), 4000))
    assert (np.abs(POINTS) <= HALVES + 1e-9).all()
    random = POINTS[len(BOX.vertices) :]
    top = np.isclose(random[:, 2], HALVES[2]).mean()
    areas = HALVES[[0, 1, 2]] * HALVES[[1, 2, 0]]
    assert top == pytest.approx(areas[0] / (2.0 * areas.sum()), abs=0.03)


def test_displaced_grasps_keep_clear_of_hand_and_object() -> None:
    config = Displacements()
    tried = TriedGrasps(np.stack([from_above(0.02), from_above(0.02, 0.02)]), np.array([1.0, 0.0]))
    # A finger of the person's on top, in the way of the first grasp.
    hand = Balls(np.array([[0.0, 0.0, HALVES[2] + 0.012]]), np.array([0.01]))
    assert rooms(tried.poses[:1], hand, 0.08)[0] < 0.0
    found = displaced(tried, POINTS, hand, 0.08, config)
    assert len(found.poses) > 0
    assert (rooms(found.poses, hand, 0.08) > config.room).all()
    assert (found.holds == 1.0).all()
    everywhere = displaced(tried, POINTS, FAR, 0.08, config)
    assert len(everywhere.poses) > len(found.poses)
    # Deeper than the box is high over the fingers' roots, so that the hand's body would be in it.
    deep = TriedGrasps(from_above(0.06)[None], np.ones(1))
    assert len(displaced(deep, POINTS, FAR, 0.08, replace(config, back=(0.0,))).poses) == 0


def test_nothing_is_displaced_where_nothing_holds() -> None:
    tried = TriedGrasps(from_above(0.02)[None], np.zeros(1))
    assert displaced(tried, POINTS, FAR, 0.08, Displacements()).poses.shape == (0, 7)


def test_at_most_so_many_are_displaced() -> None:
    tried = TriedGrasps(np.stack([from_above(0.02, 0.001 * number) for number in range(10)]), np.ones(10))
    assert len(displaced(tried, POINTS, FAR, 0.08, Displacements(most=20)).poses) <= 20
