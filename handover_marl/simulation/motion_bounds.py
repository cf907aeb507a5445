"""Lower bounds on the number of steps in which the Panda cannot touch human hand or objects."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, PandaConfig
from handover_marl.geometry.kinematic_tree import BoundingSphere, KinematicTree
from handover_marl.geometry.poses import transform_points

Array = npt.NDArray[np.float64]

# Distance of two spheres below which their bodies count as near (m); Bullet searches contacts within 2 cm.
_MARGIN = 0.03


class RobotMotionBounds:
    """Bounds on the motion of a Panda's links, from spheres around their collision shapes.

    In every step, a joint moves towards its target by a fixed fraction of its error. While its motor is too weak to
    stop it, it may also move on at its present speed. A point of the arm therefore moves at most by the sum, over all
    joints, of both motions times the distance from the joint to the farthest point that it carries.

    Args:
        tree: Kinematic tree of the robot.
        spheres: Bounding sphere of every link that has collision shapes; -1 is the base link.
        config: Base pose and motors of the robot.

    Attributes:
        links: Numbers of the L links that have collision shapes, without the base.
        link_centers: Centers (L, 3) of these links' spheres in the frames of the links (m).
        base_centers: Center (1, 3) of the sphere of the base in the world (m); (0, 3) if it has no collision shapes.
    """

    def __init__(self, tree: KinematicTree, spheres: Mapping[int, BoundingSphere], config: PandaConfig) -> None:
        self._gain = config.motor.position_gain
        base = [spheres[-1]] if -1 in spheres else []
        self.links = [link for link in spheres if link >= 0]
        self.link_centers = np.stack([spheres[link].center for link in self.links])
        self._radii = np.array([spheres[link].radius for link in self.links] + [sphere.radius for sphere in base])
        self.base_centers = transform_points(
            np.array([*config.base_position, *config.base_orientation]),
            np.array([sphere.center for sphere in base]).reshape(-1, 3),
        )
        moving = tree.moving_links
        # A prismatic finger joint carries nothing that rotates.
        self._levers = np.array(
            [1.0 if tree.joints[link].kind == "prismatic" else tree.compute_reach(link, spheres) for link in moving]
        )

    def count_contact_free_steps(
        self,
        joints: tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]],
        link_poses: npt.NDArray[np.floating],
        robot_target: npt.ArrayLike,
        centers: Array,
        radii: Array,
    ) -> npt.NDArray[np.int_]:
        """Return lower bounds on the number of steps before the robot can touch each of m bodies.

        All arrays may have the leading dimensions (...) of a batch of worlds.

        Args:
            joints: Current positions (..., 9) and velocities (..., 9) of the robot (rad, m).
            link_poses: Current world poses (..., L, 7; quaternions xyzw) of the links in the attribute `links`.
            robot_target: Joint targets (..., 9) of the robot, constant in the n coming steps (rad, m).
            centers: Centers (..., n, m, 3) of spheres around the bodies after each step (m); inf for absent bodies.
            radii: Radii (..., m) of the spheres around the bodies (m).

        Returns:
            Step counts (..., m), at most n.
        """
        steps = centers.shape[-3]
        position, velocity = joints
        errors = np.abs(np.asarray(robot_target) - position) @ self._levers
        speed = np.abs(velocity) @ self._levers
        count = np.arange(1, steps + 1)
        moved = errors[..., None] * (1.0 - (1.0 - self._gain) ** count) + speed[..., None] * TIME_STEP * count
        robot = self.compute_sphere_centers(link_poses)
        # Bodies are mostly so far away that one bound over all steps suffices.
        start = centers[..., :1, :, :]
        with np.errstate(invalid="ignore"):
            # An absent body is at infinity. If it appears or disappears, inf - inf is nan, which does not count as far.
            body_moved = _norm(centers - start).max(axis=-2, keepdims=True)
            far = self._distances(start, robot) - radii[..., None, :] - body_moved - moved[..., -1:, None] >= _MARGIN
        if far.all():
            return np.full(np.broadcast_shapes(moved.shape[:-1], centers.shape[:-3]) + centers.shape[-2:-1], steps)
        near = self._distances(centers, robot) - radii[..., None, :] - moved[..., None] < _MARGIN
        return np.asarray(np.where(near.any(axis=-2), near.argmax(axis=-2), steps))

    def compute_sphere_centers(self, link_poses: npt.NDArray[np.floating]) -> Array:
        """Return world centers (..., b, 3) in m of b spheres of `links` and base for link poses (..., L, 7; xyzw)."""
        links = transform_points(link_poses, self.link_centers)
        base = np.broadcast_to(self.base_centers, (*links.shape[:-2], *self.base_centers.shape))
        return np.concatenate([links, base], axis=-2)

    def is_near(self, robot_centers: Array, centers: Array, radii: Array) -> npt.NDArray[np.bool_]:
        """Return a mask (...) of the worlds of a batch in which the sphere around any of m bodies is near the robot.

        Args:
            robot_centers: Centers (..., b, 3) of the robot's spheres (m). Spheres less than 3 cm apart are near.
            centers: Centers (..., m, 3) of spheres around the bodies (m); inf for absent bodies.
            radii: Radii (..., m) of the spheres around the bodies (m).
        """
        distances = self._distances(centers[..., None, :, :], robot_centers)[..., 0, :]
        return np.asarray((distances - radii < _MARGIN).any(axis=-1))

    def _distances(self, points: Array, robot_centers: Array) -> Array:
        """Return distances (..., n, m) in m from points (..., n, m, 3) to the surface of the nearest robot sphere."""
        gaps = _norm(points[..., None, :] - robot_centers[..., None, None, :, :]) - self._radii
        distances: Array = gaps.min(axis=-1)
        return distances


def _norm(vectors: Array) -> Array:
    """Return the lengths (...) of vectors (..., 3), faster than `np.linalg.norm`."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    lengths: Array = np.sqrt(x * x + y * y + z * z)
    return lengths
