"""Collision avoidance: joint velocities that keep clear of bodies, and via points around obstacles.

Velocities are limited by a velocity damper (Faverjon and Tournassoud, 1987), as in speed and separation monitoring of
ISO/TS 15066: the speed at which robot and body approach each other is at most the clearance beyond a minimum, divided
by a time constant.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import CheckedConfig, bounded
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.robot_clearance import (
    Spheres,
    compute_arm_clearances,
    compute_lowest_heights,
    compute_open_gripper_clearances,
    find_closest_arm_points,
    find_closest_points,
)

Array = npt.NDArray[np.float64]

_DAMPING = 1e-4
_N_SWEEPS = 4
# Fractions of a straight path at which clearances are checked.
_SHARES = np.array([0.25, 0.5, 0.75, 1.0])
# Candidate via points: offsets from the middle of the path (rad).
_OFFSETS = np.random.default_rng(0).normal(0.0, 0.6, (50, 7))
_BATCH_SIZE = 6
_TOLERANCE = 1e-9  # m


@dataclass(frozen=True, eq=False)
class MovingBody:
    """Moving body that the robot has to keep clear of.

    Attributes:
        spheres: Spheres that approximate the body, in the world.
        velocity: (3,) velocity of the body in the world (m/s).
        min_clearance: Minimum clearance between robot and body (m).
    """

    spheres: Spheres
    velocity: Array
    min_clearance: float


@dataclass(frozen=True)
class SeparationConfig(CheckedConfig):
    """Clearances that the moving robot keeps from the person, the object and the table.

    Attributes:
        hand_clearance: Minimum clearance to the person's hand before the final approach (m).
        object_clearance: Minimum clearance to the object that is handed over, on the way to a standoff pose (m).
        grasp_hand_clearance: Minimum clearance to the person's hand during the final approach (m).
        obstacle_clearance: Minimum clearance to the other objects before the final approach (m).
        grasp_obstacle_clearance: Minimum clearance to the other objects during the final approach (m).
        table_clearance: Minimum clearance above the table (m).
        time_constant: Shortest time in which the robot may use up the clearance beyond the minimum (s).
        approach_time_constant: Value of `time_constant` during the final approach to a grasp (s).
        max_evasion_speed: Maximum speed at which the robot moves away from a body closer than the minimum (m/s).
        lookahead: Time for which clearances are predicted, as those to a quickly passing body shrink abruptly (s).
        slack: Amount by which a predicted clearance may fall below the minimum before another velocity is chosen (m).
    """

    default_limits: ClassVar[tuple[float, float]] = (0.0, math.inf)

    hand_clearance: float = 0.03
    object_clearance: float = 0.015
    grasp_hand_clearance: float = 0.003
    obstacle_clearance: float = 0.01
    grasp_obstacle_clearance: float = 0.0
    table_clearance: float = 0.01
    time_constant: float = bounded(0.15, 1e-6)
    approach_time_constant: float = bounded(0.05, 1e-6)
    max_evasion_speed: float = 0.6
    lookahead: float = 0.06
    slack: float = 0.003


def enforce_separation(
    velocity: Array,
    arm: ArmInWorld,
    joints: Array,
    bodies: Sequence[MovingBody],
    config: SeparationConfig,
    leaving: bool = False,
) -> Array:
    """Return joint velocities (7,) in rad/s near `velocity` that keep the robot at joints (7,) in rad clear of bodies.

    The robot approaches each body at most with the clearance beyond the minimum, divided by `config.time_constant`. If
    not all limits can be kept, the last body has priority. The robot moves away from a body whose clearance is below
    the minimum. With `leaving`, for the withdrawal from a person's hand, it is enough that the robot does not come
    closer to such a body.
    """
    hand, dampers = arm.compute_hand_pose(joints), []
    for body in bodies:
        gripper = find_closest_points(hand, body.spheres)
        for closest, link in (find_closest_arm_points(arm, joints, body.spheres), (gripper, arm.arm.n_joints)):
            wanted = min(body.min_clearance, closest.distance) if leaving else body.min_clearance
            retreat = min((wanted - closest.distance) / config.time_constant, config.max_evasion_speed)
            min_rate = retreat + float(closest.normal @ body.velocity)
            dampers.append((closest.normal @ arm.compute_point_jacobian(joints, closest.point, link), min_rate))
    # One constraint may undo what another has enforced, so all are swept several times.
    for row, min_rate in _N_SWEEPS * dampers:
        rate = float(row @ velocity)
        if rate < min_rate:
            velocity = velocity + row * (min_rate - rate) / (row @ row + _DAMPING)
    return velocity


def select_safe_velocity(
    candidates: Array,
    reachable: Array,
    arm: ArmInWorld,
    joints: Array,
    bodies: Sequence[MovingBody],
    table_height: float,
    config: SeparationConfig,
) -> Array:
    """Return the first of several joint velocities (7,) that keeps all clearances at the end of the lookahead.

    Each clearance must be at least the smaller of its minimum and its present value, minus `config.slack`. If all
    candidates violate this, the one with the smallest violation is returned. The `candidates` (n, 7) in rad/s are
    ordered by preference. Clearances are predicted with `reachable` (n, 7): the velocity that the motors can reach for
    each candidate. The arm is at `joints` (7,) in rad, the table's surface at `table_height`, world z in m.
    """
    line = np.concatenate([joints[None], joints + config.lookahead * reachable])
    hands, heights = arm.compute_hand_poses(line), compute_lowest_heights(arm, line) - table_height
    violations = np.maximum(0.0, min(config.table_clearance, float(heights[0])) - config.slack - heights[1:])
    for body in bodies:
        spheres = body.spheres
        predicted = Spheres(spheres.centers + config.lookahead * body.velocity, spheres.radii)
        now = min(
            float(compute_open_gripper_clearances(hands[:1], spheres)[0]),
            float(compute_arm_clearances(arm, line[:1], spheres)[0]),
        )
        clearances = np.minimum(
            compute_open_gripper_clearances(hands[1:], predicted), compute_arm_clearances(arm, line[1:], predicted)
        )
        violations = np.maximum(violations, min(body.min_clearance, now) - config.slack - clearances)
    return np.asarray(candidates[int(np.argmin(violations))])


@dataclass(frozen=True, eq=False)
class PathObstacles:
    """Obstacles that a path of the arm has to keep clear of.

    Attributes:
        spheres: Spheres that approximate all bodies but the table, in the world.
        table_height: World z of the table's surface (m).
        clearance: Wanted clearance of the robot to bodies and table (m).
    """

    spheres: Spheres
    table_height: float
    clearance: float


def is_path_clear(arm: ArmInWorld, start: Array, goal: Array, obstacles: PathObstacles) -> bool:
    """Return whether arm and open gripper keep clear of obstacles on the straight joint path from start to goal, (7,).

    Clearances are checked at four points of the path. If the start has less than the wanted clearance, it is enough
    that these points have at least the clearance of the start.
    """
    path = start + _SHARES[:, None] * (goal - start)
    return bool(_are_clear(arm, start, path[None], obstacles)[0])


def find_via_point(
    arm: ArmInWorld,
    start: Array,
    goal: Array,
    extra_candidates: Array,
    speeds: Array,
    obstacles: PathObstacles,
    max_candidates: int,
) -> Array | None:
    """Return the via point (7,) of the fastest clear path from start to goal, (7,) in rad; None if none is clear.

    A path is straight in joint space from start to via point, and from via point to goal; it is clear by the rule of
    `is_path_clear`. Candidates are `extra_candidates` (n, 7) and 50 fixed pseudo-random points around the middle of
    start and goal. Only the `max_candidates` fastest paths at joint speeds `speeds` (7,) in rad/s are checked.
    """
    candidates = np.clip(np.concatenate([extra_candidates, 0.5 * (start + goal) + _OFFSETS]), *arm.limits)
    to_candidate = (np.abs(candidates - start) / speeds).max(axis=1)
    time = to_candidate + (np.abs(candidates - goal) / speeds).max(axis=1)
    fastest = candidates[np.argsort(time, kind="stable")[:max_candidates]]
    shares = _SHARES[:, None, None]
    for batch in np.split(fastest, range(_BATCH_SIZE, len(fastest), _BATCH_SIZE)):
        paths = np.concatenate([start + shares * (batch - start), batch + shares * (goal - batch)]).swapaxes(0, 1)
        is_clear = _are_clear(arm, start, paths, obstacles)
        if is_clear.any():
            return np.asarray(batch[int(np.argmax(is_clear))])
    return None


def _are_clear(arm: ArmInWorld, start: Array, paths: Array, obstacles: PathObstacles) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the paths (n, k, 7) whose k points all keep clear by the rule of `is_path_clear`."""
    line = np.concatenate([start[None], paths.reshape(-1, paths.shape[-1])])
    spheres = obstacles.spheres
    clearances = np.minimum(
        compute_arm_clearances(arm, line, spheres),
        compute_open_gripper_clearances(arm.compute_hand_poses(line), spheres),
    )
    clearances = np.minimum(clearances, compute_lowest_heights(arm, line) - obstacles.table_height)
    is_enough = clearances[1:] >= min(float(clearances[0]), obstacles.clearance) - _TOLERANCE
    return np.asarray(is_enough.reshape(paths.shape[:2]).all(axis=1))
