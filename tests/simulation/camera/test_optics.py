"""Tests of the wrist camera's deprojection against an independent pinhole model."""

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.simulation.camera.optics import HANDOVERSIM_MODEL, PINHOLE_MODEL, WRIST_CAMERA, deproject

SHAPE = (224, 224)

seeds = st.integers(0, 2**32 - 1)


def image_positions(points: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Project points (n, 3) in the hand's frame to (n, 2) right and down (pixels), independently of the library."""
    ahead, right, up = (points.astype(np.float64) - (0.036, 0.0, 0.036)).T[[2, 1, 0]]
    return np.stack([112.0 + 112.0 * right / ahead, 112.0 - 112.0 * up / ahead], axis=1)


def random_picture(seed: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(WRIST_CAMERA.near, WRIST_CAMERA.far, SHAPE).astype(np.float32)
    return depth, rng.random(SHAPE) < rng.choice([0.001, 0.1, 0.9])


@settings(max_examples=10)
@given(seeds)
def test_points_project_to_the_sampled_positions(seed: int) -> None:
    """Points of the pinhole model project to the sampled positions; HandoverSim's are shifted up by one pixel."""
    depth, seen = random_picture(seed)
    points, shifted = deproject(depth, seen, PINHOLE_MODEL), deproject(depth, seen, HANDOVERSIM_MODEL)
    rows, columns = np.nonzero(seen)
    np.testing.assert_allclose(image_positions(points), np.stack([columns, rows + 1], axis=1), atol=2e-4)
    np.testing.assert_allclose(points[:, 2] - 0.036, depth[seen], atol=3e-7)
    np.testing.assert_array_equal(shifted[:, 1:], points[:, 1:])
    # The image's upward direction is the x axis of the hand's frame.
    np.testing.assert_allclose(shifted[:, 0] - points[:, 0], depth[seen] / 112.0, atol=3e-7)
