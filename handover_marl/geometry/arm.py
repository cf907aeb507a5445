"""Forward kinematics of the Panda for many configurations, a test for unreachable poses, and the interface of IK.

Link frames and Jacobians are in the frame of the robot's base. The axis of the n configurations is the last one in link
frames and `compute_jacobian`, e.g. (3, n) origins; it is the first one in joints and `compute_hand_jacobians`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import SimulationError
from handover_marl.geometry.arrays import AnyArray, as_arrays, get_namespace, is_tensor
from handover_marl.geometry.kinematic_tree import REVOLUTE, KinematicTree
from handover_marl.geometry.panda import FINGER_LINKS, HAND_LINK, OPEN, SHOULDER_HEIGHT
from handover_marl.geometry.poses import transform_points

Array = npt.NDArray[np.float64]

# Largest distance (m) from the Panda's shoulder to its hand link, and to its wrist.
_ARM_LENGTH, _WRIST_RANGE = 0.8578930066326846, 0.7193542034041307
# The wrist is on a circle around the last joint's axis: height along the hand's z axis, and radius (m).
_WRIST_HEIGHT, _WRIST_RADIUS = -0.107, 0.088


@dataclass(frozen=True, eq=False)
class LinkFrames:
    """Link frames of the Panda for n configurations, in the frame of the robot's base.

    Attributes:
        origins: (L, 3, n) origins of the L links (m).
        rotations: (L, 3, 3, n) rotation matrices from the links' frames to the base frame.
    """

    origins: Array
    rotations: Array


class ArmKinematics:
    """Forward kinematics and Jacobians of a Panda with open fingers.

    Links are numbered along the chain: 0-6 are the arm's, 7 is the hand, 8 and 9 are the fingers.

    Args:
        tree: Kinematic tree of the Panda; a tree without the links of hand and fingers raises `SimulationError`.

    Attributes:
        link_names: Names of the ten links in the order of their numbers.
        n_joints: Number of revolute joints from base to hand, 7.
    """

    def __init__(self, tree: KinematicTree) -> None:
        names = [joint.link for joint in tree.joints]
        missing = {HAND_LINK, *FINGER_LINKS} - set(names)
        if missing:
            raise SimulationError(f"the robot must be a Panda, its model has no link {sorted(missing)}; check the URDF")
        hand = names.index(HAND_LINK)
        revolute, link = list[int](), hand
        while link >= 0:
            revolute = [link, *revolute] if tree.joints[link].kind in REVOLUTE else revolute
            link = tree.joints[link].parent
        self.link_names = [names[link] for link in revolute] + [HAND_LINK, *FINGER_LINKS]
        self.n_joints = len(revolute)
        for link in revolute:
            if not np.allclose(tree.joints[link].axis, (0.0, 0.0, 1.0)):
                raise SimulationError(f"the joint of {names[link]} must turn about its z axis; check the URDF")
        self._segments = [
            _fixed_transform(tree, link, before) for link, before in zip(revolute, [-1, *revolute], strict=False)
        ]
        self._hand = _fixed_transform(tree, hand, revolute[-1])
        self._fingers = [_fixed_transform(tree, names.index(finger), hand) for finger in FINGER_LINKS]

    def compute_chain_frames(self, joints: Array) -> LinkFrames:
        """Compute the base-frame poses of eight links (seven arm links, hand) at arm joints (n, 7) in rad."""
        count = len(joints)
        origins = np.empty((self.n_joints + 1, 3, count))
        rotations = np.empty((self.n_joints + 1, 3, 3, count))
        sines, cosines = np.sin(joints.T), np.cos(joints.T)
        origin, rotation = np.zeros((3, count)), np.repeat(np.eye(3)[..., None], count, axis=2)
        for number, (offset, turn) in enumerate(self._segments):
            origins[number] = origin = origin + offset @ rotation
            columns, sine, cosine = turn.T @ rotation, sines[number], cosines[number]
            x, y = columns[:, 0], columns[:, 1]
            rotation = rotations[number]
            rotation[:, 0], rotation[:, 1], rotation[:, 2] = cosine * x + sine * y, cosine * y - sine * x, columns[:, 2]
        offset, turn = self._hand
        origins[-1], rotations[-1] = origin + offset @ rotation, turn.T @ rotation
        return LinkFrames(origins, rotations)

    def compute_link_frames(self, joints: Array) -> LinkFrames:
        """Compute the base-frame poses of all ten links (arm, hand, two fingers) at arm joints (n, 7) in rad."""
        chain = self.compute_chain_frames(joints)
        origin, rotation = chain.origins[-1], chain.rotations[-1]
        fingers = [(origin + offset @ rotation, turn.T @ rotation) for offset, turn in self._fingers]
        return LinkFrames(
            np.concatenate([chain.origins, [finger[0] for finger in fingers]]),
            np.concatenate([chain.rotations, [finger[1] for finger in fingers]]),
        )

    def compute_jacobian(self, chain: LinkFrames) -> Array:
        """Compute hand link Jacobians (6, 7, n), base frame, linear rows (m/rad) first, from `compute_chain_frames`."""
        (ax, ay, az), levers = chain.rotations[:-1, :, 2].swapaxes(0, 1), chain.origins[-1] - chain.origins[:-1]
        lx, ly, lz = levers.swapaxes(0, 1)
        return np.stack([ay * lz - az * ly, az * lx - ax * lz, ax * ly - ay * lx, ax, ay, az])

    def compute_hand_jacobians(self, joints: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Compute base-frame Jacobians, positions and rotations of the hand link at arm joints (n, 7) in rad.

        The result of a configuration does not depend on the other configurations, to the last bit.

        Returns:
            Jacobians (n, 6, 7): linear rows (m/rad), then angular; positions (n, 3) in m; and rotations (n, 3, 3) from
            hand to base frame.
        """
        xp, angles, identity = as_arrays(joints, np.eye(3)[..., None])
        origin, rotation = xp.zeros_like(angles.T[:3]), xp.broadcast_to(identity, (3, 3, len(angles)))
        origins, axes = [], []
        sines, cosines = xp.sin(angles.T), xp.cos(angles.T)
        for (offset, turn), sine, cosine in zip(self._segments, sines, cosines, strict=True):
            origin = origin + _combine(offset, rotation)
            x, y, z = (_combine(column, rotation) for column in turn.T)
            rotation = xp.stack([cosine * x + sine * y, cosine * y - sine * x, z])
            origins.append(origin)
            axes.append(z)
        offset, turn = self._hand
        hand = origin + _combine(offset, rotation)
        (ax, ay, az), (lx, ly, lz) = xp.stack(axes, axis=1), hand[:, None] - xp.stack(origins, axis=1)
        rows = xp.stack([ay * lz - az * ly, az * lx - ax * lz, ax * ly - ay * lx, ax, ay, az])
        columns = xp.stack([_combine(column, rotation) for column in turn.T])
        jacobians, rotations = xp.permute_dims(rows, (2, 0, 1)), xp.permute_dims(columns, (2, 1, 0))
        # NumPy's rounding of sums depends on the order in memory.
        return jacobians if is_tensor(jacobians) else np.ascontiguousarray(jacobians), hand.T, rotations


class IndependentArmKinematics(ArmKinematics):
    """Kinematics of a Panda, in which the chain frames of a row do not depend, to the last bit, on the other rows.

    So results are the same for any batch size. The frames of the fingers may depend on other rows. Arguments and errors
    are those of `ArmKinematics`, which is slower for few rows and faster for hundreds.
    """

    def __init__(self, tree: KinematicTree) -> None:
        super().__init__(tree)
        # Homogeneous transforms (8, 4, 4) of the arm links and the hand from the link before, with joints at zero.
        self._fixed = np.zeros((self.n_joints + 1, 4, 4))
        for matrix, (offset, turn) in zip(self._fixed, [*self._segments, self._hand], strict=True):
            matrix[:3, :3], matrix[:3, 3], matrix[3, 3] = turn, offset, 1.0

    def compute_chain_frames(self, joints: Array) -> LinkFrames:
        """Compute the base-frame poses of eight links (seven arm links, hand) at arm joints (n, 7) in rad."""
        frames = np.repeat(self._fixed[None], len(joints), axis=0)
        x, y = self._fixed[:-1, :, 0], self._fixed[:-1, :, 1]
        sines, cosines = np.sin(joints)[..., None], np.cos(joints)[..., None]
        frames[:, :-1, :, 0], frames[:, :-1, :, 1] = cosines * x + sines * y, cosines * y - sines * x
        for link in range(1, self.n_joints + 1):
            # One product for each configuration: its rounding does not depend on their number.
            frames[:, link] = frames[:, link - 1] @ frames[:, link]
        return LinkFrames(frames[..., :3, 3].transpose(1, 2, 0), frames[..., :3, :3].transpose(1, 2, 3, 0))


def solve_damped(jacobians: AnyArray, twists: AnyArray, damping: float | AnyArray) -> AnyArray:
    """Return joint increments (n, 7) in rad for twists (n, 6) of the hand link, by damped least squares.

    Args:
        jacobians: Jacobians (n, 6, 7) of `ArmKinematics.compute_hand_jacobians`.
        twists: Small motions: translations (m), then rotation vectors (rad), in the base frame.
        damping: Damping factor; a larger one limits motions near singular configurations more.
    """
    xp, jacobian = get_namespace(jacobians), jacobians
    gram = xp.stack([xp.sum(jacobian * jacobian[:, row, None], axis=2) for row in range(6)], axis=1)
    identity = as_arrays(jacobians, np.eye(6))[2]
    weights = xp.linalg.solve(gram + damping**2 * identity, twists[..., None])
    return xp.sum(jacobian * weights, axis=1)


def _combine(weights: Array, vectors: AnyArray) -> AnyArray:
    """Return the sum over i of weights[i] * vectors[i], (3, n), for weights (3,) and vectors (3, 3, n)."""
    return weights[0] * vectors[0] + weights[1] * vectors[1] + weights[2] * vectors[2]


def transform_body_points(frames: LinkFrames, on_links: Sequence[Array]) -> Array:
    """Transform k points (k, 3) on each of L links from link frames to the base frame: (3, L * k, n) in m, by link."""
    moved = [
        points @ rotation + origin[:, None]
        for points, origin, rotation in zip(on_links, frames.origins, frames.rotations, strict=True)
    ]
    return np.concatenate(moved, axis=1)


def _fixed_transform(tree: KinematicTree, link: int, ancestor: int) -> tuple[Array, Array]:
    """Return offset (3,) in m and rotation (3, 3) of a link in an ancestor's frame; both are link numbers in `tree`.

    Revolute joints are at zero, prismatic joints at the position of open fingers. The base link has the number -1.
    """
    offset, turn = np.zeros(3), np.eye(3)
    while link != ancestor:
        joint = tree.joints[link]
        slide = OPEN * joint.axis if joint.kind == "prismatic" else np.zeros(3)
        offset = joint.offset + joint.rotation @ (slide + offset)
        turn = joint.rotation @ turn
        link = joint.parent
    return offset, turn


class ReachabilityBound:
    """Test for poses of the hand link that the Panda cannot reach, by two necessary conditions.

    Joint limits are ignored. The hand link must not be farther from the shoulder than the arm is long. At a given hand
    orientation, the wrist (origin of `panda_joint6`) can only be on a circle around the axis of `panda_joint7`. At
    least one point of that circle must be no farther from the shoulder than the arm is long up to the wrist.

    Args:
        world_from_base: (7,) pose of the robot's base, xyz (m) and quaternion xyzw.
    """

    def __init__(self, world_from_base: Array) -> None:
        self._shoulder = transform_points(world_from_base, (0.0, 0.0, SHOULDER_HEIGHT))

    def is_unreachable(
        self, position: npt.ArrayLike, orientation: npt.ArrayLike | None, distance: float, angle: float
    ) -> npt.NDArray[np.bool_]:
        """Return a mask (...) of the world poses that the hand link certainly cannot reach.

        Positions (..., 3) are in m, orientations (..., 4) are quaternions xyzw or None for any. A pose counts as
        reached if the hand link is within `distance` (m) and `angle` (rad) of it.
        """
        target = np.asarray(position, dtype=np.float64)
        is_too_far = np.asarray(np.linalg.norm(target - self._shoulder, axis=-1) > _ARM_LENGTH + distance)
        if orientation is None:
            return is_too_far
        world_from_hand = Rotation.from_quat(np.asarray(orientation, dtype=np.float64))
        shoulder = world_from_hand.apply(self._shoulder - target, inverse=True)
        radius = np.linalg.norm(shoulder[..., :2], axis=-1)
        nearest = np.hypot(shoulder[..., 2] - _WRIST_HEIGHT, radius - _WRIST_RADIUS)
        slack = distance + angle * np.hypot(_WRIST_HEIGHT, _WRIST_RADIUS)
        return np.asarray(is_too_far | (nearest > _WRIST_RANGE + slack))


def as_row(values: npt.ArrayLike) -> Array:
    """Return k values as a float64 array (1, k)."""
    return np.asarray(values, dtype=np.float64)[None]


class IkSolver(Protocol):
    """Interface of inverse kinematics solvers that iterate until the hand link reaches a pose."""

    def solve(
        self, start: npt.ArrayLike, position: npt.ArrayLike, orientation: npt.ArrayLike | None = None
    ) -> Array | None:
        """Return arm joints (7,) in rad that bring the hand link to a world pose, or None without convergence.

        The search starts at joints `start` (9,); finger joints are ignored. The pose is a position (3,) in m and an
        orientation, a quaternion (4,) xyzw or None for any.
        """
        found: Array = self.solve_many(
            as_row(start), as_row(position), None if orientation is None else as_row(orientation)
        )[0]
        return None if np.isnan(found[0]) else found

    def solve_many(
        self, starts: npt.NDArray[np.floating], positions: Array, orientations: Array | None = None
    ) -> Array:
        """Return arm joints (n, 7) in rad that bring the hand link to n world poses; rows without convergence are nan.

        Searches start at joints (n, 9). Positions (n, 3) are in m, orientations (n, 4) quaternions xyzw, None for any.
        """
