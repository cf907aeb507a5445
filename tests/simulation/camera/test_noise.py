"""Tests of camera noise: depth noise, dropout at edges, pixel stride and the check of their values."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.errors import OptionError
from handover_marl.simulation.camera.images import CameraImage, SegmentationLabel
from handover_marl.simulation.camera.noise import (
    CAMERA_NOISE_MODELS,
    CameraNoise,
    apply_camera_noise,
    resolve_camera_noise,
)
from handover_marl.simulation.camera.optics import WRIST_CAMERA

SHAPE = (224, 224)
NONE = CameraNoise(depth_noise_std=0.0, edge_dropout=0.0, latency=0.0)


def make_patches(seed: int) -> CameraImage:
    """Return an image of rectangles at random depths before an empty background; some steps are too small for edges."""
    rng = np.random.default_rng(seed)
    depth, seen = np.full(SHAPE, WRIST_CAMERA.empty_depth, dtype=np.float32), np.zeros(SHAPE, dtype=np.uint8)
    for _ in range(12):
        row, column, high, wide = rng.integers(0, [200, 200, 90, 90])
        place = slice(row, row + high + 1), slice(column, column + wide + 1)
        depth[place] = rng.choice([rng.uniform(0.1, 1.9), 0.5, 0.515, 0.53])
        seen[place] = rng.integers(1, 6)
    return CameraImage(depth, seen, rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8))


def find_edges(depth: npt.NDArray[np.float32], step: float) -> npt.NDArray[np.bool_]:
    """Return a mask of the pixels whose depth differs by more than `step` (m) from one of the four neighbors."""
    framed = np.pad(depth, 1, mode="edge")
    neighbors = [framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:]]
    return np.array(np.any([np.abs(other - depth) > step for other in neighbors], axis=0))


def worsen(photo: CameraImage, camera: CameraNoise, seed: int = 0) -> CameraImage:
    return apply_camera_noise(photo, camera, np.random.default_rng(seed))


def test_pixels_without_noise_are_unchanged() -> None:
    photo = make_patches(0)
    same, half = worsen(photo, NONE), worsen(photo, replace(NONE, pixel_stride=2))
    for name in ("depth", "segmentation", "rgb"):
        np.testing.assert_array_equal(getattr(same, name), getattr(photo, name))
    assert same.depth.dtype == np.float32
    assert same.segmentation.dtype == np.uint8
    others = np.ones(SHAPE, dtype=bool)
    others[::2, ::2] = False
    for name, empty in (("depth", WRIST_CAMERA.empty_depth), ("segmentation", SegmentationLabel.BACKGROUND)):
        np.testing.assert_array_equal(getattr(half, name), np.where(others, empty, getattr(photo, name)))


@pytest.mark.parametrize("distance", [0.1, 1.9])
def test_noise_grows_with_the_square_of_the_depth(distance: float) -> None:
    photo = CameraImage(np.full(SHAPE, distance, dtype=np.float32), np.ones(SHAPE, dtype=np.uint8))
    apart = (worsen(photo, CameraNoise()).depth - photo.depth).astype(np.float64)
    assert apart.std() == pytest.approx(0.0036 * distance**2, rel=0.02)
    assert abs(apart.mean()) < 0.02 * apart.std()
    assert abs(np.corrcoef(apart[:, 1:].ravel(), apart[:, :-1].ravel())[0, 1]) < 0.02, "pixels are independent"
    assert worsen(photo, replace(NONE, depth_noise_std=300.0)).depth.min() == 0.0, "no depth is negative"


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.sampled_from([0.005, 0.02, 0.3]))
def test_only_edge_pixels_are_dropped(seed: int, share: float, step: float) -> None:
    photo = make_patches(seed)
    camera = CameraNoise(depth_noise_std=0.001, edge_dropout=share, edge_threshold=step)
    worse, edges = worsen(photo, camera, seed), find_edges(photo.depth, step)
    there = photo.depth < WRIST_CAMERA.empty_depth
    lost, wanted = there & (worse.depth == WRIST_CAMERA.empty_depth), edges & there
    assert not (lost & ~edges).any()
    assert lost.sum() == pytest.approx(share * wanted.sum(), abs=5.0 * np.sqrt(wanted.sum() / 4) + 1.0)
    np.testing.assert_array_equal(
        worse.segmentation != photo.segmentation, lost & (photo.segmentation != SegmentationLabel.BACKGROUND)
    )


def test_noise_depends_on_the_seed_only() -> None:
    """Rows that are equal in two images have equal noise with the same seed, whatever the other rows show."""
    first, second, camera = make_patches(4), make_patches(5), CameraNoise()
    second.depth[:40], second.segmentation[:40] = first.depth[:40], first.segmentation[:40]
    worse, same, other = worsen(first, camera, 1), worsen(second, camera, 1), worsen(first, camera, 2)
    np.testing.assert_array_equal(worse.depth[:39], same.depth[:39])
    np.testing.assert_array_equal(worse.segmentation[:39], same.segmentation[:39])
    assert (worse.depth != other.depth).mean() > 0.1


def test_noise_models_by_name() -> None:
    assert resolve_camera_noise("realsense") == CameraNoise() == CAMERA_NOISE_MODELS["realsense"]
    assert resolve_camera_noise(None) is None
    assert resolve_camera_noise(NONE) is NONE
    bad: dict[str, Any] = {"depth_noise_std": -1e-9, "edge_dropout": 1.0001, "latency": 1.0001, "pixel_stride": 0}
    for name, value in bad.items():
        with pytest.raises(OptionError, match=name):
            CameraNoise(**{name: value})
