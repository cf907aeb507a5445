"""Tests of the capsules of elbow, forearm and wrist."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.model_files.meshes import read_link_vertices
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.robot_clearance import ARM_CAPSULES, Spheres, compute_arm_clearances
from tests.planning.robots import ARM, LIMITS, START

IN_WORLD = ArmInWorld(ARM, np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068]), LIMITS)
URDF: Path = SyntheticDataset().panda_urdf


def sample_hull(vertices: np.ndarray, count: int) -> np.ndarray:
    """Return random points (count, 3) on the convex hull of a link."""
    rng = np.random.default_rng(0)
    corners = vertices[ConvexHull(vertices).simplices]
    chosen = corners[rng.integers(len(corners), size=count)]
    return np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), count), chosen)


@pytest.mark.parametrize("link", sorted({link for link, *_ in ARM_CAPSULES}))
def test_capsules_cover_the_collision_meshes(link: int) -> None:
    """Points on the meshes' convex hulls, which collide in the engine, are at most 16 mm outside of the capsules."""
    (vertices,) = read_link_vertices(URDF, "collision", [ARM.link_names[link]])
    origins, rotations = IN_WORLD.compute_link_frames(START[None])
    points = sample_hull(vertices, 400) @ rotations[0, link].T + origins[0, link]
    clearances = [
        compute_arm_clearances(IN_WORLD, START[None], Spheres(point[None], np.zeros(1)))[0] for point in points
    ]
    assert max(clearances) < 0.016
    assert np.median(clearances) > -0.06
