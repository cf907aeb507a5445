"""Distances on grids, and the cache of objects' fields."""

import logging
import multiprocessing
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.assets.object_models import object_urdf
from handover_marl.errors import DataFormatError
from handover_marl.models.distance_field import FAR, DistanceField, field_of
from handover_marl.models.meshes import model_triangles
from handover_marl.planning import field_cache
from handover_marl.planning.array_cache import cache_folder
from handover_marl.planning.field_cache import KIND, object_field
from handover_marl.planning.obstacles import nearness, steepness

RADIUS, REACH = 0.05, 0.2
MARGIN = 0.1


def ball() -> DistanceField:
    corner = np.full(3, REACH)
    return field_of(lambda points: np.linalg.norm(points, axis=1) - RADIUS, -corner, corner, 0.005)


BALL = ball()
places = st.lists(st.floats(-0.19, 0.19), min_size=3, max_size=3).map(np.array)


@given(places)
def test_distances_and_slopes_of_a_ball(place: np.ndarray) -> None:
    points = place[:, None].astype(np.float32)
    distance, slope = BALL.distances_and_slopes(points)
    length = np.linalg.norm(place)
    assert distance[0] == pytest.approx(length - RADIUS, abs=2e-3)
    assert BALL.distances(points)[0] == distance[0]
    if length > 0.02:
        np.testing.assert_allclose(slope[:, 0], place / length, atol=0.15)


@given(places)
def test_slopes_are_the_derivative_of_what_is_interpolated(place: np.ndarray) -> None:
    # Within one cell, away from its faces, where the slope jumps.
    cells = (place + REACH) / 0.005
    place = (np.floor(cells) + 0.5) * 0.005 - REACH
    small = 1e-3
    _, slope = BALL.distances_and_slopes(place[:, None].astype(np.float32))
    for axis in range(3):
        step = small * np.eye(3)[axis]
        ends = np.stack([place - step, place + step], axis=1).astype(np.float32)
        below, above = BALL.distances(ends)
        assert slope[axis, 0] == pytest.approx((above - below) / (2 * small), abs=2e-3)


def test_beyond_the_grid_is_far() -> None:
    points = np.array([[0.3, 0.0, 0.0], [0.0, -0.21, 0.0], [0.0, 0.0, 0.1]], dtype=np.float32).T
    distance, slope = BALL.distances_and_slopes(points)
    assert distance[:2].tolist() == [FAR, FAR]
    assert distance[2] < FAR
    assert not slope[:, :2].any()


@given(st.floats(-0.1, 0.3), st.floats(0.05, 0.2))
def test_cost_falls_to_nothing_and_its_derivative_is_right(distance: float, padding: float) -> None:
    small = 1e-5
    around = np.array([distance - small, distance, distance + small])
    below, here, above = nearness(around, padding)
    assert here >= 0.0
    assert (here == 0.0) == (distance >= padding)
    assert steepness(around, padding)[1] == pytest.approx((above - below) / (2 * small), abs=1e-3)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    field_cache._field.cache_clear()
    return cache_folder(KIND)


def test_field_of_a_box(cache: Path, fake_data: Path) -> None:
    urdf = next((fake_data / "assets").glob("*/model_normalized.urdf"))
    vertices, _ = model_triangles(urdf)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low - 0.08, high + 0.08, (200, 3))
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    inside = np.minimum(points - low, high - points).min(axis=1)
    wanted = np.where(inside > 0.0, -inside, np.linalg.norm(outside, axis=1))
    # Between the grid's nodes edges come out rounded.
    np.testing.assert_allclose(object_field(urdf, MARGIN).distances(points.T.astype(np.float32)), wanted, atol=3e-3)


def test_a_cut_file_is_made_anew(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    urdf = object_urdf("040_large_marker")
    first = object_field(urdf, MARGIN)
    (kept,) = cache.iterdir()
    whole = kept.read_bytes()
    for spoiled in (whole[: len(whole) // 2], b"", b"no field"):
        kept.write_bytes(spoiled)
        field_cache._field.cache_clear()
        with caplog.at_level(logging.WARNING):
            again = object_field(urdf, MARGIN)
        assert kept.name in caplog.text
        np.testing.assert_array_equal(again.values, first.values)
        assert kept.read_bytes() == whole
        caplog.clear()


def test_a_kept_field_is_read_and_no_other(cache: Path) -> None:
    urdf = object_urdf("040_large_marker")
    first = object_field(urdf, MARGIN)
    (kept,) = cache.iterdir()
    np.savez_compressed(kept, values=first.values + 1.0, lower=first.lower, cell=first.cell)
    field_cache._field.cache_clear()
    np.testing.assert_array_equal(object_field(urdf, MARGIN).values, first.values + 1.0)
    assert object_field(urdf, MARGIN / 2).values.shape < first.values.shape
    assert len(list(cache.iterdir())) == 2


def test_another_mesh_is_another_field(cache: Path, tmp_path: Path) -> None:
    folder = tmp_path / "own" / "040_large_marker"
    shutil.copytree(object_urdf("040_large_marker").parent, folder)
    object_field(folder / "model_normalized.urdf", MARGIN)
    mesh = folder / "model_normalized_convex.obj"
    mesh.write_text(mesh.read_text().replace("v 0.0", "v 0.1", 1))
    field_cache._field.cache_clear()
    object_field(folder / "model_normalized.urdf", MARGIN)
    assert len(list(cache.iterdir())) == 2


def test_processes_share_the_folder(cache: Path) -> None:
    urdf = object_urdf("040_large_marker")
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        sums = pool.starmap(_sum, [(urdf, MARGIN)] * 4)
    assert len(set(sums)) == 1
    assert [path.suffix for path in cache.iterdir()] == [".npz"]


def _sum(urdf: Path, margin: float) -> float:
    return float(object_field(urdf, margin).values.sum())


def test_without_a_cache_folder_fields_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    field_cache._field.cache_clear()
    assert object_field(object_urdf("040_large_marker"), MARGIN).values.min() < 0.0
    assert "not kept" in caplog.text


def test_a_damaged_mesh_is_named(own_data: Path, cache: Path) -> None:
    folder = own_data / "assets" / "own"
    shutil.copytree(object_urdf("040_large_marker").parent, folder)
    (folder / "model_normalized_convex.obj").write_text("v 1 2\nf a b c\n")
    with pytest.raises(DataFormatError, match="model_normalized_convex"):
        object_field(folder / "model_normalized.urdf", MARGIN)
