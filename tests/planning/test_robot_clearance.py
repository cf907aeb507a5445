"""Tests of clearances of the gripper, and of the capsules of elbow, forearm and wrist."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.model_files.meshes import read_link_vertices
from handover_marl.geometry.poses import compose, transform_points
from handover_marl.planning.robot_clearance import (
    ARM_CAPSULES,
    GRIPPER_BOX_CENTERS,
    GRIPPER_BOX_HALF_SIZES,
    Spheres,
    compute_arm_clearances,
    compute_grasp_clearances,
    find_closest_points,
)
from tests.planning.robots import ARM, IN_WORLD, START

HERE = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
positions = st.lists(st.floats(-0.25, 0.25), min_size=3, max_size=3).map(np.array)
rotations = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def sphere(position: np.ndarray, radius: float = 0.01) -> Spheres:
    return Spheres(np.asarray(position, dtype=np.float64)[None], np.array([radius]))


def pose(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.concatenate([position, Rotation.from_rotvec(rotation).as_quat()])


@pytest.mark.parametrize(
    ("position", "sweep", "clearance"),
    [
        ((0.0, 0.0, 0.2), 0.0, 0.0774),  # before the closed fingers
        ((0.0, 0.0, 0.1), 0.0, -0.0205),  # between the pads, where fingers will close
        ((0.0, 0.154, 0.02), 0.0, 0.04),  # beside the hand's body
        ((0.1, 0.0, -0.065), 0.0, 0.035),  # beside the flange
        ((0.0, 0.09, -0.2), 0.0, 0.09),  # behind the whole gripper
        ((0.0, 0.09, -0.2), 0.1, 0.025),  # on the way of the flange to the grasp
    ],
)
def test_grasp_clearance(position: tuple[float, ...], sweep: float, clearance: float) -> None:
    found = compute_grasp_clearances(HERE, sphere(np.array(position)), sweep)[0]
    assert found == pytest.approx(clearance, abs=2e-3)


@pytest.mark.slow
@given(positions, rotations)
def test_closest_points_match_the_clearance(position: np.ndarray, rotation: np.ndarray) -> None:
    hand = pose(np.array([0.3, -0.1, 0.2]), rotation)
    point = transform_points(hand, position)
    closest = find_closest_points(hand, sphere(point))
    beyond = np.abs(position - GRIPPER_BOX_CENTERS) - GRIPPER_BOX_HALF_SIZES
    distances = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    if distances.min() > 1e-3:
        assert closest.distance == pytest.approx(distances.min() - 0.01, abs=1e-9)
        assert np.linalg.norm(closest.point - point) == pytest.approx(closest.distance + 0.01, abs=1e-9)
        # Moving along the normal increases the distance by at most the same amount.
        moved = compose(np.array([*(0.02 * closest.normal), 0.0, 0.0, 0.0, 1.0]), hand)
        assert find_closest_points(moved, sphere(point)).distance <= closest.distance + 0.02 + 1e-9
        assert np.dot(closest.normal, closest.point - point) == pytest.approx(closest.distance + 0.01, abs=1e-9)
    assert np.linalg.norm(closest.normal) == pytest.approx(1.0)


def sample_hull(vertices: np.ndarray, count: int) -> np.ndarray:
    """Return random points (count, 3) on the convex hull of a link."""
    rng = np.random.default_rng(0)
    corners = vertices[ConvexHull(vertices).simplices]
    chosen = corners[rng.integers(len(corners), size=count)]
    return np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), count), chosen)


@pytest.mark.parametrize("link", sorted({link for link, *_ in ARM_CAPSULES}))
def test_capsules_cover_the_collision_meshes(link: int) -> None:
    """Points on the meshes' convex hulls, which collide in the engine, are at most 16 mm outside of the capsules."""
    (vertices,) = read_link_vertices(SyntheticDataset().panda_urdf, "collision", [ARM.link_names[link]])
    origins, rotations = IN_WORLD.compute_link_frames(START[None])
    points = sample_hull(vertices, 400) @ rotations[0, link].T + origins[0, link]
    clearances = [
        compute_arm_clearances(IN_WORLD, START[None], Spheres(point[None], np.zeros(1)))[0] for point in points
    ]
    assert max(clearances) < 0.016
    assert np.median(clearances) > -0.06
