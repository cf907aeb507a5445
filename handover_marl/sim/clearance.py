"""For how many steps the Panda surely stays away from what the giver moves."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP, PandaConfig
from handover_marl.models.kinematic_tree import KinematicTree, Sphere
from handover_marl.models.poses import compose_point

Array = npt.NDArray[np.float64]

#: Distance (m) between balls below which two things count as near; Bullet begins to look for contacts at 2 cm.
MARGIN = 0.03


class Clearance:
    """Bounds on where a Panda's links can get.

    A joint goes straight for its target, a fixed share of the way in every step; where its motor is too weak to
    turn it round at once, it first coasts on. So no point of the arm moves further than the sum over the joints of
    both ways, times how far the joint's load reaches.

    Args:
        tree: The robot's links.
        spheres: A ball around the shapes of every link that has some; -1 is the base.
        config: How its joints are driven.

    Attributes:
        links: The links that have shapes, the base left out.
    """

    def __init__(self, tree: KinematicTree, spheres: Mapping[int, Sphere], config: PandaConfig) -> None:
        self._gain = config.motor.position_gain
        base = [spheres[-1]] if -1 in spheres else []
        self.links = [link for link in spheres if link >= 0]
        self._centers = np.stack([spheres[link].center for link in self.links])
        radii = [spheres[link].radius for link in self.links] + [sphere.radius for sphere in base]
        self._radii = np.array(radii)
        self._base_centers = compose_point(
            np.array([*config.base_position, *config.base_orientation]),
            np.array([sphere.center for sphere in base]).reshape(-1, 3),
        )
        moving = [link for link, joint in enumerate(tree.joints) if joint.kind != "fixed"]
        # A finger slides, and nothing swings on it.
        self._levers = np.array(
            [1.0 if tree.joints[link].kind == "prismatic" else tree.reach(link, spheres) for link in moving]
        )

    def clear_steps(
        self,
        joints: tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]],
        link_poses: npt.NDArray[np.floating],
        robot_target: npt.ArrayLike,
        centers: Array,
        radii: Array,
    ) -> npt.NDArray[np.int_]:
        """(..., m) how many of the coming n steps are surely without contact, for each of m things in (...) worlds.

        Args:
            joints: Positions (..., 9) and velocities (..., 9) of the robot's joints now (rad, m).
            link_poses: (..., L, 7) world poses of `links` now.
            robot_target: (..., 9) joint targets for all these steps.
            centers: (..., n, m, 3) where the middles of balls around the things are after each step (m).
            radii: (..., m) the balls' radii (m).
        """
        steps = centers.shape[-3]
        position, velocity = joints
        ways = np.abs(np.asarray(robot_target) - position) @ self._levers
        speed = np.abs(velocity) @ self._levers
        count = np.arange(1, steps + 1)
        moved = ways[..., None] * (1.0 - (1.0 - self._gain) ** count) + speed[..., None] * TIME_STEP * count
        robot = self.balls(link_poses)
        # Mostly everything is so far apart that it need not be looked at step by step.
        start = centers[..., :1, :, :]
        with np.errstate(invalid="ignore"):
            # Things that come or go are at infinity on the way; what is not a number is not far.
            moves = _lengths(centers - start).max(axis=-2, keepdims=True)
            far = self._gaps(start, robot) - radii[..., None, :] - moves - moved[..., -1:, None] >= MARGIN
        if far.all():
            return np.full(np.broadcast_shapes(moved.shape[:-1], centers.shape[:-3]) + centers.shape[-2:-1], steps)
        near = self._gaps(centers, robot) - radii[..., None, :] - moved[..., None] < MARGIN
        return np.asarray(np.where(near.any(axis=-2), near.argmax(axis=-2), steps))

    def balls(self, link_poses: npt.NDArray[np.floating]) -> Array:
        """(..., b, 3) the middles of all balls (m), given world poses (..., L, 7) of `links`."""
        links = compose_point(link_poses, self._centers)
        base = np.broadcast_to(self._base_centers, (*links.shape[:-2], *self._base_centers.shape))
        return np.concatenate([links, base], axis=-2)

    def near(self, balls: Array, centers: Array, radii: Array) -> npt.NDArray[np.bool_]:
        """(...) whether any of m things is near the robot at some moments.

        Args:
            balls: (..., b, 3) what `balls` says of them (m).
            centers: (..., m, 3) the middles of balls around the things; infinite where they are not there (m).
            radii: (m,) the balls' radii (m).
        """
        gaps = _lengths(centers[..., None, :] - balls[..., None, :, :]) - self._radii
        return np.asarray((gaps.min(axis=-1) - radii < MARGIN).any(axis=-1))

    def _gaps(self, centers: Array, robot: Array) -> Array:
        """(..., n, m) distances (m) of points (..., n, m, 3) to the nearest of the robot's balls (..., L, 3)."""
        found: Array = (_lengths(centers[..., None, :] - robot[..., None, None, :, :]) - self._radii).min(axis=-1)
        return found


def _lengths(ways: Array) -> Array:
    """(...) of vectors (..., 3); NumPy reduces short axes slowly."""
    x, y, z = ways[..., 0], ways[..., 1], ways[..., 2]
    found: Array = np.sqrt(x * x + y * y + z * z)
    return found
