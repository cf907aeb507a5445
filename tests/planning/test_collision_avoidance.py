"""Tests of clearances of gripper and arm, of speed and separation monitoring, and of via points around obstacles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.model_files.meshes import read_link_vertices
from handover_marl.geometry.poses import compose, transform_points
from handover_marl.planning.collision_avoidance import (
    MovingBody,
    PathObstacles,
    SeparationConfig,
    enforce_separation,
    find_via_point,
    is_path_clear,
    select_safe_velocity,
)
from handover_marl.planning.robot_clearance import (
    ARM_CAPSULES,
    GRIPPER_BOX_CENTERS,
    GRIPPER_BOX_HALF_SIZES,
    Spheres,
    compute_arm_clearances,
    compute_grasp_clearances,
    find_closest_arm_points,
    find_closest_points,
)
from tests.planning.robots import ARM, IN_WORLD, START

CONFIG = SeparationConfig()
HAND = IN_WORLD.compute_hand_pose(START)

vectors = st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7).map(np.array)


def make_body(clearance: float, min_clearance: float, moving: float = 0.0) -> MovingBody:
    """Return a sphere in front of a fingertip that moves along the gripper's axis (m/s)."""
    position = transform_points(HAND, np.array([0.0, 0.05, 0.1126 + clearance + 0.01]))
    axis = transform_points(HAND, np.array([0.0, 0.0, 1.0])) - HAND[:3]
    return MovingBody(Spheres(position[None], np.array([0.01])), moving * axis, min_clearance)


def approach_speed(velocity: np.ndarray, body: MovingBody) -> float:
    """Return the rate at which the clearance decreases (m/s), by finite differences."""
    step = 1e-5
    clearances = [
        find_closest_points(IN_WORLD.compute_hand_pose(START + duration * velocity), body.spheres).distance
        for duration in (0.0, step)
    ]
    return (clearances[0] - clearances[1]) / step


@pytest.mark.slow
@given(vectors, st.floats(0.005, 0.2))
def test_clearance_decreases_slowly(velocity: np.ndarray, clearance: float) -> None:
    body = make_body(clearance, 0.03)
    found = enforce_separation(velocity, IN_WORLD, START, [body], CONFIG)
    distance = find_closest_points(HAND, body.spheres).distance
    assert (
        approach_speed(found, body) <= max((distance - 0.03) / CONFIG.time_constant, -CONFIG.max_evasion_speed) + 5e-3
    )


def test_all_bodies_are_respected() -> None:
    """The robot moves away from both of two spheres that are too close, at a fingertip and beside the forearm."""
    origins, rotations = IN_WORLD.compute_link_frames(START[None])
    cover = origins[0, 4] + rotations[0, 4] @ np.array([0.0, 0.15, -0.05])
    bodies = [MovingBody(Spheres(cover[None], np.array([0.01])), np.zeros(3), 0.03), make_body(0.01, 0.03)]
    found = enforce_separation(np.array([0.5, 0.5, -0.5, 0.5, 0.5, 0.5, 0.5]), IN_WORLD, START, bodies, CONFIG)
    assert approach_speed(found, bodies[1]) < 0.0
    before, after = (
        find_closest_arm_points(IN_WORLD, q, bodies[0].spheres)[0].distance for q in (START, START + 1e-5 * found)
    )
    assert after > before


def test_first_safe_velocity_is_selected() -> None:
    body = make_body(0.05, 0.03)
    towards = np.linalg.pinv(IN_WORLD.compute_jacobian(START)[:3]) @ (
        transform_points(HAND, np.array([0.0, 0.0, 1.0])) - HAND[:3]
    )
    wanted = np.array([1.0, 0.5, 0.2, 0.0])[:, None] * towards

    def chosen(reached: np.ndarray) -> np.ndarray:
        return select_safe_velocity(wanted, reached, IN_WORLD, START, [body], 0.0, CONFIG)

    # The clearance may decrease by 2 cm and the slack within the lookahead.
    found = approach_speed(chosen(wanted), body) * CONFIG.lookahead
    assert 0.005 < found <= 0.02 + CONFIG.slack + 1e-3
    # The reached velocity counts: without braking, no candidate is better than the first.
    np.testing.assert_array_equal(chosen(np.repeat(wanted[:1], 4, axis=0)), wanted[0])
    np.testing.assert_array_equal(chosen(wanted[[0, 0, 0, 3]]), wanted[3])


MIDDLE = np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.2, 0.785])
# Joint positions on both sides of MIDDLE, which differ in the first joint.
LEFT, RIGHT = (MIDDLE + side * np.eye(7)[0] for side in (-0.7, 0.7))
#: Spheres far away, and at the hand's position in the middle of the path.
FAR = Spheres(np.array([[5.0, 5.0, 5.0]]), np.array([0.1]))
NEAR = Spheres(IN_WORLD.compute_hand_pose(MIDDLE)[None, :3], np.array([0.05]))
TABLE, CLEARANCE = 0.5, 0.01


def is_clear(joints: np.ndarray, goal: np.ndarray, bodies: Spheres) -> bool:
    return is_path_clear(IN_WORLD, joints, goal, PathObstacles(bodies, TABLE, CLEARANCE))


def test_via_point_avoids_the_obstacle_that_blocks_the_path() -> None:
    assert is_clear(LEFT, RIGHT, FAR)
    assert not is_clear(LEFT, RIGHT, NEAR)
    assert is_clear(LEFT, LEFT + 0.2 * (RIGHT - LEFT), NEAR)
    obstacles = PathObstacles(NEAR, TABLE, CLEARANCE)
    found = find_via_point(IN_WORLD, LEFT, RIGHT, np.zeros((0, 7)), np.full(7, 2.0), obstacles, 24)
    assert found is not None
    assert is_clear(LEFT, found, NEAR)
    assert is_clear(found, RIGHT, NEAR)
    low, high = IN_WORLD.limits
    assert ((found >= low) & (found <= high)).all()


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
