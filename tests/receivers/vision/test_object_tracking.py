import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.receivers.vision.grasp_tracker import FilterGains, Keyframe, PositionFilter


def test_position_filter_tracks_and_coasts() -> None:
    position_filter, gains = PositionFilter(0.1), FilterGains(0.5, 0.1, 0.4)
    for number in range(100):
        position_filter.update(0.05 * number, np.array([0.2 * 0.05 * number, 0.0, 0.0]), gains)
    np.testing.assert_allclose(position_filter.velocity, [0.2, 0.0, 0.0], atol=1e-3)
    assert position_filter.position is not None
    np.testing.assert_allclose(position_filter.position, [0.99, 0.0, 0.0], atol=1e-3)
    for number in range(100):
        position_filter.coast(5.0 + 0.05 * number)
    assert np.linalg.norm(position_filter.velocity) < 1e-4


@given(seed=st.integers(0, 2**16), size=st.floats(0.0, 0.012))
@settings(max_examples=25)
def test_registration_of_a_sphere(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(3000, 3))
    ball *= 0.05 / np.linalg.norm(ball, axis=1, keepdims=True)
    translation = rng.normal(size=3)
    translation *= size / np.linalg.norm(translation)
    found, share = Keyframe(ball).register(ball[::7] + translation, max_distance=0.03)
    assert share == 1.0
    assert np.linalg.norm(found - translation) < 0.2 * size + 0.001
