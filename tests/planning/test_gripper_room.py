"""Room of a gripper beside a hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import compose, compose_point
from handover_marl.planning.capsules import Capsules
from handover_marl.planning.gripper_room import (
    BOX_HALVES,
    BOX_MIDDLES,
    Balls,
    balls_of,
    corners,
    nearest,
    rooms,
    surface_balls,
)

HERE = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_FACES = np.array(
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)

places = st.lists(st.floats(-0.25, 0.25), min_size=3, max_size=3).map(np.array)
turns = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def ball(place: np.ndarray, radius: float = 0.01) -> Balls:
    return Balls(np.asarray(place, dtype=np.float64)[None], np.array([radius]))


def pose(place: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.concatenate([place, Rotation.from_rotvec(turn).as_quat()])


@pytest.mark.parametrize(
    ("place", "sweep", "room"),
    [
        ((0.0, 0.0, 0.2), 0.0, 0.0774),  # before the closed fingers
        ((0.0, 0.0, 0.1), 0.0, -0.0205),  # between the pads, where fingers will close
        ((0.0, 0.154, 0.02), 0.0, 0.04),  # beside the hand's body
        ((0.1, 0.0, -0.065), 0.0, 0.035),  # beside the flange
        ((0.0, 0.09, -0.2), 0.0, 0.09),  # behind it all
        ((0.0, 0.09, -0.2), 0.1, 0.025),  # where the flange comes from
    ],
)
def test_room(place: tuple[float, ...], sweep: float, room: float) -> None:
    found = rooms(HERE, ball(np.array(place)), sweep)[0]
    assert found == pytest.approx(room, abs=2e-3)


@given(places, places, turns)
def test_room_goes_with_the_gripper(place: np.ndarray, way: np.ndarray, turn: np.ndarray) -> None:
    moved = pose(way, turn)
    at_home = rooms(HERE, ball(place))[0]
    assert rooms(moved[None], ball(compose_point(moved, place)))[0] == pytest.approx(at_home, abs=1e-9)


@given(places, turns)
def test_the_nearest_point_is_as_far_as_the_room(place: np.ndarray, turn: np.ndarray) -> None:
    hand = pose(np.array([0.3, -0.1, 0.2]), turn)
    there = compose_point(hand, place)
    near = nearest(hand, ball(there))
    beyond = np.abs(place - BOX_MIDDLES) - BOX_HALVES
    distances = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    if distances.min() > 1e-3:
        assert near.room == pytest.approx(distances.min() - 0.01, abs=1e-9)
        assert np.linalg.norm(near.point - there) == pytest.approx(near.room + 0.01, abs=1e-9)
        # Going away from the hand there makes as much room.
        moved = compose(np.array([*(0.02 * near.away), 0.0, 0.0, 0.0, 1.0]), hand)
        assert nearest(moved, ball(there)).room <= near.room + 0.02 + 1e-9
        assert np.dot(near.away, near.point - there) == pytest.approx(near.room + 0.01, abs=1e-9)
    assert np.linalg.norm(near.away) == pytest.approx(1.0)


def test_the_nearest_of_several_balls_is_named() -> None:
    balls = Balls(np.array([[0.0, 0.0, 0.4], [0.0, 0.2, 0.02], [0.0, 0.0, 0.3]]), np.array([0.01, 0.01, 0.01]))
    near = nearest(HERE[0], balls)
    assert near.ball == 1
    assert near.room == pytest.approx(0.086)
    np.testing.assert_allclose(near.away, [0.0, -1.0, 0.0])


def test_corners_are_those_of_all_boxes() -> None:
    lower, upper = (BOX_MIDDLES - BOX_HALVES).min(axis=0), (BOX_MIDDLES + BOX_HALVES).max(axis=0)
    found = corners(np.stack([HERE[0], np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])]))
    assert found.shape == (2, 32, 3)
    np.testing.assert_allclose(found[0].min(axis=0), lower)
    np.testing.assert_allclose(found[0].max(axis=0), upper)
    np.testing.assert_allclose(found[1], found[0] + [1.0, 0.0, 0.0])


def test_capsules_become_balls_from_end_to_end() -> None:
    capsules = Capsules(np.zeros((2, 3)), np.array([[0.0, 0.0, 0.2], [0.2, 0.0, 0.0]]), np.array([0.01, 0.02]))
    balls = balls_of(capsules, 3)
    assert sorted(map(tuple, balls.centers[balls.radii == 0.02])) == [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.2, 0.0, 0.0)]
    assert len(balls.centers) == 6


def test_balls_lie_on_a_surface_and_cover_it() -> None:
    balls = surface_balls(CUBE, CUBE_FACES, 60, 0.05)
    on_face = np.isclose(balls.centers, 0.0) | np.isclose(balls.centers, 1.0)
    assert on_face.any(axis=1).all()
    assert (balls.centers >= -1e-9).all()
    assert (balls.centers <= 1.0 + 1e-9).all()
    rng = np.random.default_rng(0)
    points = rng.uniform(size=(300, 3))
    points[np.arange(300), rng.integers(0, 3, 300)] = rng.integers(0, 2, 300)
    assert np.linalg.norm(points[:, None] - balls.centers, axis=-1).min(axis=1).max() < 0.4
