import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.receivers.vision.object_track import KeyView, SeenBody, Track, Trust

RNG = np.random.default_rng(0)
CLOUD = 0.02 * RNG.normal(size=(100, 3))


def test_what_is_hidden_is_remembered_for_a_while_and_while_it_is_near() -> None:
    body = SeenBody(cube=0.01, memory=1.0)
    here, there = np.zeros((1, 3)), np.full((1, 3), 0.5)
    body.see(0.0, here, forget=True)
    body.see(0.5, there, forget=True)
    assert len(body.points) == 2
    body.see(2.0, there, forget=False)
    assert len(body.points) == 2
    body.see(2.1, np.zeros((0, 3)), forget=True)
    assert len(body.points) == 2
    body.see(2.2, there, forget=True)
    np.testing.assert_array_equal(body.points, there)


def test_tracks_follow_what_moves_and_rest_with_what_rests() -> None:
    track, trust = Track(0.1), Trust(0.5, 0.1, 0.4)
    for number in range(100):
        track.see(0.05 * number, np.array([0.2 * 0.05 * number, 0.0, 0.0]), trust)
    np.testing.assert_allclose(track.velocity, [0.2, 0.0, 0.0], atol=1e-3)
    assert track.place is not None
    np.testing.assert_allclose(track.place, [0.99, 0.0, 0.0], atol=1e-3)
    for number in range(100):
        track.coast(5.0 + 0.05 * number)
    assert np.linalg.norm(track.velocity) < 1e-4


@given(seed=st.integers(0, 2**16), size=st.floats(0.0, 0.012))
@settings(max_examples=25, deadline=None)
def test_looks_tell_how_a_surface_moved(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(3000, 3))
    ball *= 0.05 / np.linalg.norm(ball, axis=1, keepdims=True)
    way = rng.normal(size=3)
    way *= size / np.linalg.norm(way)
    found, share = KeyView(ball).beside(ball[::7] + way, reach=0.03)
    assert share == 1.0
    assert np.linalg.norm(found - way) < 0.2 * size + 0.001


def test_along_planes_nothing_is_told() -> None:
    rng = np.random.default_rng(0)
    plane = np.c_[rng.uniform(-0.1, 0.1, (3000, 2)), np.zeros(3000)]
    found, share = KeyView(plane).beside(plane[::7] + np.array([0.01, 0.0, 0.005]), reach=0.03)
    assert share > 0.9
    np.testing.assert_allclose(found, [0.0, 0.0, 0.005], atol=2e-4)


def test_other_surfaces_are_no_part_of_a_look() -> None:
    key = KeyView(CLOUD)
    assert key.beside(CLOUD + 1.0, reach=0.03)[1] == 0.0
    both = np.concatenate([CLOUD, CLOUD + 1.0])
    assert key.beside(both, reach=0.03)[1] == pytest.approx(0.5)


def test_a_look_of_few_points_is_a_look() -> None:
    assert KeyView(CLOUD[:3]).beside(CLOUD, reach=0.03)[0].shape == (3,)
