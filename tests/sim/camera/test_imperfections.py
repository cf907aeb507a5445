"""What is wrong with a camera, and only that."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.sim.camera.imperfections import CAMERAS, CameraImperfections, imperfections, worsened
from handover_marl.sim.camera.optics import NOTHING
from handover_marl.sim.camera.photo import Photo, Seen

SHAPE = (224, 224)
NONE = CameraImperfections(depth_noise=0.0, edge_drop=0.0, latency=0.0)
RGB = np.random.default_rng(9).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)


def flat(depth: float) -> Photo:
    return Photo(np.full(SHAPE, depth, dtype=np.float32), np.full(SHAPE, Seen.TABLE, dtype=np.uint8))


def patches(seed: int) -> Photo:
    """Rectangles at random depths before nothing, some of them too little apart to be edges."""
    rng = np.random.default_rng(seed)
    depth = np.full(SHAPE, NOTHING, dtype=np.float32)
    seen = np.zeros(SHAPE, dtype=np.uint8)
    for _ in range(12):
        row, column, high, wide = rng.integers(0, [200, 200, 90, 90])
        place = slice(row, row + high + 1), slice(column, column + wide + 1)
        depth[place] = rng.choice([rng.uniform(0.1, 1.9), 0.5, 0.515, 0.53])
        seen[place] = rng.integers(1, 6)
    return Photo(depth, seen, RGB)


def beside_edges(depth: npt.NDArray[np.float32], step: float) -> npt.NDArray[np.bool_]:
    """Whether one of the four neighbours is more than a step away."""
    framed = np.pad(depth, 1, mode="edge")
    neighbours = [framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:]]
    return np.array(np.any([np.abs(other - depth) > step for other in neighbours], axis=0))


def taken(photo: Photo, camera: CameraImperfections, seed: int = 0) -> Photo:
    return worsened(photo, camera, np.random.default_rng(seed))


seeds = st.integers(0, 10_000)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_a_camera_without_faults_takes_perfect_pictures(seed: int) -> None:
    photo = patches(seed)
    same = taken(photo, NONE, seed)
    np.testing.assert_array_equal(same.depth, photo.depth)
    np.testing.assert_array_equal(same.segmentation, photo.segmentation)
    np.testing.assert_array_equal(same.rgb, RGB)
    assert (same.depth.dtype, same.segmentation.dtype) == (np.float32, np.uint8)


def test_fewer_pixels_show_what_they_showed() -> None:
    photo = patches(0)
    half = taken(photo, replace(NONE, every=2))
    np.testing.assert_array_equal(half.depth[::2, ::2], photo.depth[::2, ::2])
    np.testing.assert_array_equal(half.segmentation[::2, ::2], photo.segmentation[::2, ::2])
    others = np.ones(photo.depth.shape, dtype=bool)
    others[::2, ::2] = False
    assert (half.depth[others] == NOTHING).all()
    assert (half.segmentation[others] == Seen.BACKGROUND).all()


@pytest.mark.parametrize("every", [0, -1, 1.5, True])
def test_every_so_many_pixels_is_a_count(every: Any) -> None:
    with pytest.raises(OptionError, match="every"):
        CameraImperfections(every=every)


@pytest.mark.parametrize("distance", [0.1, 0.5, 1.0, 1.9])
def test_noise_grows_with_the_square_of_the_depth(distance: float) -> None:
    photo = flat(distance)
    apart = (taken(photo, CameraImperfections()).depth - photo.depth).astype(np.float64)
    assert apart.std() == pytest.approx(0.0036 * distance**2, rel=0.02)
    assert abs(apart.mean()) < 0.02 * apart.std()
    # Of every pixel its own.
    assert abs(np.corrcoef(apart[:, 1:].ravel(), apart[:, :-1].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(apart[1:].ravel(), apart[:-1].ravel())[0, 1]) < 0.02


def test_noise_is_as_large_as_it_is_asked_for() -> None:
    photo = flat(1.0)
    single, double = (taken(photo, replace(NONE, depth_noise=noise)).depth - 1.0 for noise in (0.01, 0.02))
    np.testing.assert_allclose(double, 2.0 * single, atol=1e-6)
    assert single.std() == pytest.approx(0.01, rel=0.02)


def test_nothing_is_nearer_than_the_pinhole() -> None:
    depth = taken(flat(1.5), replace(NONE, depth_noise=3.0)).depth
    assert depth.min() == 0.0
    assert (depth == 0.0).mean() > 0.1


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.0, 1.0), st.sampled_from([0.005, 0.02, 0.3]))
def test_pixels_are_lost_beside_edges_only(seed: int, share: float, step: float) -> None:
    photo = patches(seed)
    camera = CameraImperfections(depth_noise=0.001, edge_drop=share, edge_step=step)
    worse, edges = taken(photo, camera, seed), beside_edges(photo.depth, step)
    there = photo.depth < NOTHING
    lost = there & (worse.depth == NOTHING)
    assert not (lost & ~edges).any()
    wanted = edges & there
    assert lost.sum() == pytest.approx(share * wanted.sum(), abs=5.0 * np.sqrt(wanted.sum() / 4) + 1.0)
    changed = worse.segmentation != photo.segmentation
    np.testing.assert_array_equal(changed, lost & (photo.segmentation != Seen.BACKGROUND))
    assert (worse.segmentation[lost] == Seen.BACKGROUND).all()


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_all_or_none_beside_edges(seed: int) -> None:
    photo = patches(seed)
    there = photo.depth < NOTHING
    every = taken(photo, CameraImperfections(edge_drop=1.0, depth_noise=0.0))
    np.testing.assert_array_equal(every.depth == NOTHING, beside_edges(photo.depth, 0.02) | ~there)
    none = taken(photo, CameraImperfections(edge_drop=0.0))
    np.testing.assert_array_equal(none.depth == NOTHING, ~there)
    np.testing.assert_array_equal(none.segmentation, photo.segmentation)


def test_nothing_stays_nothing() -> None:
    photo = Photo(np.full(SHAPE, NOTHING, dtype=np.float32), np.zeros(SHAPE, dtype=np.uint8))
    worse = taken(photo, CameraImperfections(depth_noise=0.1, edge_drop=1.0))
    assert (worse.depth == NOTHING).all()
    assert not worse.segmentation.any()


def test_colours_are_not_touched() -> None:
    assert taken(patches(0), CameraImperfections()).rgb is RGB
    assert taken(flat(1.0), CameraImperfections()).rgb is None


def test_the_perfect_picture_is_not_touched() -> None:
    photo = patches(3)
    before = photo.depth.copy(), photo.segmentation.copy()
    worse = taken(photo, CameraImperfections())
    worse.depth[...], worse.segmentation[...] = 0.0, 0
    np.testing.assert_array_equal(photo.depth, before[0])
    np.testing.assert_array_equal(photo.segmentation, before[1])


def test_what_is_drawn_comes_from_the_seed() -> None:
    photo, camera = patches(4), CameraImperfections()
    first, again, other = (taken(photo, camera, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.depth, again.depth)
    np.testing.assert_array_equal(first.segmentation, again.segmentation)
    assert (first.depth != other.depth).mean() > 0.1
    assert (first.segmentation != other.segmentation).any()


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_what_is_drawn_does_not_depend_on_what_is_seen(seed: int) -> None:
    """A pixel that shows the same in two pictures comes out the same, whatever is beside it."""
    first, second = patches(seed), patches(seed + 1)
    second.depth[:40], second.segmentation[:40] = first.depth[:40], first.segmentation[:40]
    worse = [taken(photo, CameraImperfections(), seed) for photo in (first, second)]
    np.testing.assert_array_equal(worse[0].depth[:39], worse[1].depth[:39])
    np.testing.assert_array_equal(worse[0].segmentation[:39], worse[1].segmentation[:39])


def test_cameras_by_name() -> None:
    assert imperfections("realsense") == CameraImperfections() == CAMERAS["realsense"]
    assert imperfections(None) is None
    assert imperfections(NONE) is NONE
    with pytest.raises(UnknownNameError, match="unknown camera 'kinect'; valid: realsense"):
        imperfections("kinect")


@pytest.mark.parametrize("wrong", [3, 0.5, {}, CameraImperfections, True])
def test_things_that_are_no_cameras(wrong: Any) -> None:
    with pytest.raises(OptionError, match="imperfections="):
        imperfections(wrong)


@pytest.mark.parametrize("name", ["depth_noise", "edge_step", "edge_drop", "latency"])
@pytest.mark.parametrize("value", [-1e-9, float("nan"), float("inf"), "0.1", None, True, [0.1]])
def test_impossible_numbers(name: str, value: Any) -> None:
    with pytest.raises(OptionError, match=name):
        CameraImperfections(**{name: value})


@pytest.mark.parametrize(("name", "value"), [("edge_drop", 1.0001), ("latency", 1.0001), ("latency", 50)])
def test_numbers_that_are_too_large(name: str, value: float) -> None:
    with pytest.raises(OptionError, match=name):
        CameraImperfections(**{name: value})
    CameraImperfections(**{name: 1})
