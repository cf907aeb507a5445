"""Tests of signed distance fields and their cache."""

import logging
from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.shipped import find_object_urdf
from handover_marl.geometry.array_cache import get_cache_folder
from handover_marl.geometry.distance_field import CACHE_KIND, sample_distance_field
from handover_marl.geometry.distance_field import load_object_sdf as load_cached_object_sdf
from handover_marl.geometry.model_files.meshes import read_collision_mesh

RADIUS, REACH, CELL = 0.05, 0.2, 0.005
BALL = sample_distance_field(
    lambda points: np.linalg.norm(points, axis=1) - RADIUS, np.full(3, -REACH), np.full(3, REACH), CELL
)
MARGIN = 0.1
# Without the cache in memory.
load_object_sdf = load_cached_object_sdf.__wrapped__  # type: ignore[attr-defined]


def test_distances_and_gradients_of_a_ball() -> None:
    points = np.random.default_rng(0).uniform(-0.19, 0.19, (300, 3))
    distances, slopes = BALL.compute_distances_and_gradients(points.T.astype(np.float32))
    lengths = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(distances, lengths - RADIUS, atol=2e-3)
    np.testing.assert_array_equal(BALL.compute_distances(points.T.astype(np.float32)), distances)
    far = lengths > 0.02
    np.testing.assert_allclose(slopes.T[far], (points / lengths[:, None])[far], atol=0.15)
    # Gradients are derivatives at the centers of cells; they jump at the faces.
    points, small = (np.floor((points + REACH) / CELL) + 0.5) * CELL - REACH, 1e-3
    _, slopes = BALL.compute_distances_and_gradients(points.T.astype(np.float32))
    for axis in range(3):
        step = small * np.eye(3)[axis]
        below, above = (BALL.compute_distances((points + way * step).T.astype(np.float32)) for way in (-1, 1))
        np.testing.assert_allclose(slopes[axis], (above - below) / (2 * small), atol=2e-3)


def test_distance_outside_the_grid() -> None:
    points = np.array([[0.3, 0.0, 0.0], [0.0, -0.21, 0.0], [0.0, 0.0, 0.1]], dtype=np.float32).T
    distance, slope = BALL.compute_distances_and_gradients(points)
    assert (distance == 1.0).tolist() == [True, True, False]
    assert not slope[:, :2].any()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return get_cache_folder(CACHE_KIND)


def test_field_of_a_box(cache: Path, fake_data: Path) -> None:
    urdf = next((fake_data / "assets").glob("*/model_normalized.urdf"))
    vertices, _ = read_collision_mesh(urdf)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = np.random.default_rng(0).uniform(low - 0.08, high + 0.08, (200, 3))
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    inside = np.minimum(points - low, high - points).min(axis=1)
    wanted = np.where(inside > 0.0, -inside, np.linalg.norm(outside, axis=1))
    # Interpolation between the grid's nodes rounds off edges.
    found = load_object_sdf(urdf, MARGIN).compute_distances(points.T.astype(np.float32))
    np.testing.assert_allclose(found, wanted, atol=3e-3)


def test_a_truncated_cache_file_is_computed_again(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    urdf = find_object_urdf("040_large_marker")
    first = load_object_sdf(urdf, MARGIN)
    (kept,) = cache.iterdir()
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2])
    with caplog.at_level(logging.WARNING):
        again = load_object_sdf(urdf, MARGIN)
    assert kept.name in caplog.text
    np.testing.assert_array_equal(again.values, first.values)
    assert kept.read_bytes() == whole


def test_fields_are_computed_without_a_cache_folder(cache: Path, caplog: pytest.LogCaptureFixture) -> None:
    cache.parent.write_text("")
    assert load_object_sdf(find_object_urdf("040_large_marker"), MARGIN).values.min() < 0.0
    assert "not saved" in caplog.text


def test_users_without_a_home_have_a_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """Containers run programs as users who have neither HOME nor an entry in the list of users."""

    def find_no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", find_no_home)
    assert get_cache_folder(CACHE_KIND).parts[-2:] == ("handover_marl", CACHE_KIND)
