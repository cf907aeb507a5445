"""Rods that stand for the arm's middle links."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.models.meshes import link_vertices
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import RODS, nearest_rod, rod_rooms
from handover_marl.planning.gripper_room import Balls
from tests.planning.robots import ARM, LIMITS, START, random_joints

IN_WORLD = ArmInWorld(ARM, np.array([0.61, -0.5, 0.875, 0.0, 0.0, 0.7071068, 0.7071068]), LIMITS)
URDF: Path = SyntheticDataset().panda_urdf


def on_hull(vertices: np.ndarray, count: int) -> np.ndarray:
    """(count, 3) points at random on the convex hull of a link."""
    rng = np.random.default_rng(0)
    corners = vertices[ConvexHull(vertices).simplices]
    chosen = corners[rng.integers(len(corners), size=count)]
    return np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), count), chosen)


@pytest.mark.parametrize("link", sorted({link for link, *_ in RODS}))
def test_they_cover_what_the_engine_collides_with(link: int) -> None:
    """Which is the hulls of the collision meshes."""
    (vertices,) = link_vertices(URDF, "collision", [ARM.link_names[link]])
    origins, turns = IN_WORLD.frames(START[None])
    points = on_hull(vertices, 400) @ turns[0, link].T + origins[0, link]
    rooms = [rod_rooms(IN_WORLD, START[None], Balls(point[None], np.zeros(1)))[0] for point in points]
    assert max(rooms) < 0.016
    assert np.median(rooms) > -0.06


@given(st.integers(0, 10_000))
def test_one_and_many_configurations_agree(seed: int) -> None:
    joints = random_joints(seed, 3)
    rng = np.random.default_rng(seed)
    balls = Balls(rng.uniform(-0.5, 1.5, (5, 3)), rng.uniform(0.0, 0.05, 5))
    many = rod_rooms(IN_WORLD, joints, balls)
    for one, room in zip(joints, many, strict=True):
        near, link = nearest_rod(IN_WORLD, one, balls)
        assert near.room == pytest.approx(room, abs=1e-7)
        # The point is on the rod's surface, and the ball's is where it looks to.
        back = near.point - near.room * near.away
        assert np.linalg.norm(back - balls.centers[near.ball]) == pytest.approx(balls.radii[near.ball], abs=1e-9)
        assert link in {rod[0] for rod in RODS}


@given(st.integers(0, 10_000))
def test_frames_are_where_the_links_are(seed: int) -> None:
    joints = random_joints(seed, 2)
    origins, turns = IN_WORLD.frames(joints)
    np.testing.assert_allclose(origins[:, 6] + 0.107 * turns[:, 6, :, 2], IN_WORLD.hands(joints)[:, :3], atol=1e-6)
    np.testing.assert_allclose(turns @ turns.swapaxes(-1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    # The elbow is 8.25 cm aside of the shoulder's line, seen from the upper arm (the Panda's data sheet).
    elbow = np.einsum("nij,ni->nj", turns[:, 2], origins[:, 3] - origins[:, 2])
    np.testing.assert_allclose(elbow, [[0.0825, 0.0, 0.0]] * 2, atol=1e-9)
