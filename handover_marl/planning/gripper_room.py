"""How much room a gripper has beside a person's hand, for many poses of the gripper at once."""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import inverse_transform_points
from handover_marl.planning.capsules import Capsules

Array = npt.NDArray[np.float64]

#: The open gripper in the frame of the Panda's hand link as boxes, middles and half sizes (m): the hand's body, the
#: two fingers, the flange behind it. The bounds of HandoverSim's collision meshes, the flange's without its corners.
BOX_MIDDLES = np.array([[0.0, 0.0, 0.02], [0.0, 0.0533, 0.0855], [0.0, -0.0533, 0.0855], [0.0, 0.0, -0.065]])
BOX_HALVES = np.array(
    [[0.0316, 0.104, 0.046], [0.0105, 0.0133, 0.0271], [0.0105, 0.0133, 0.0271], [0.055, 0.055, 0.04]]
)

# What the fingers sweep when they close, and what the hand's body and the flange sweep on the way to a grasp.
_CLOSING = (np.array([0.0, 0.0, 0.0855]), np.array([0.0105, 0.0666, 0.0271]))
_COMING = (0, 3)
# Between the pads, half sizes about their middle, a little less than where the fingers can press (m).
_BETWEEN = (np.array([0.0, 0.0, 0.094]), np.array([0.008, 0.04, 0.014]))

_FACING = 1e-9
_GRID = np.linspace(0.0, 1.0, 6)


@dataclass(frozen=True, eq=False)
class Balls:
    """A body as balls: `centers` (k, 3) and `radii` (k,), in m."""

    centers: Array
    radii: Array

    def seen_from(self, pose: Array) -> "Balls":
        """The same in the frame of a pose (7,)."""
        return Balls(inverse_transform_points(pose, self.centers), self.radii)


@dataclass(frozen=True, eq=False)
class Nearest:
    """Where gripper and hand come nearest.

    Attributes:
        room: Their distance (m), negative where they overlap.
        point: (3,) the nearest point of the gripper.
        away: (3,) unit vector from the hand to the gripper there.
        ball: Which ball of the hand it is.
    """

    room: float
    point: Array
    away: Array
    ball: int


def balls_of(capsules: Capsules, count: int) -> Balls:
    """Capsules as `count` balls each, evenly along their axes."""
    shares = np.linspace(0.0, 1.0, count)[:, None, None]
    centers = capsules.starts + shares * (capsules.ends - capsules.starts)
    return Balls(centers.reshape(-1, 3), np.tile(capsules.radii, count))


def corners(hands: Array) -> Array:
    """(n, 32, 3) corners of the open gripper's boxes at poses (n, 7) of the hand link."""
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    local = (BOX_MIDDLES[:, None] + signs * BOX_HALVES[:, None]).reshape(-1, 3)
    turns = Rotation.from_quat(hands[:, 3:]).as_matrix()
    found: Array = local @ turns.transpose(0, 2, 1) + hands[:, None, :3]
    return found


def surface_balls(vertices: Array, faces: npt.NDArray[np.int_], count: int, radius: float) -> Balls:
    """`count` balls of a radius (m) over the surface of a mesh, spread evenly."""
    shares = np.array([(a, b, 1.0 - a - b) for a in _GRID for b in _GRID if a + b <= 1.0])
    points = np.einsum("sk,fkc->fsc", shares, vertices[faces]).reshape(-1, 3)
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return Balls(points[chosen], np.full(len(chosen), radius))


def flange_rooms(hands: Array, balls: Balls) -> Array:
    """(n,) distances (m) between balls and the flange behind the hand at poses (n, 7), negative inside."""
    turns = Rotation.from_quat(hands[:, 3:]).as_matrix()
    local = (balls.centers[None] - hands[:, None, :3]) @ turns - BOX_MIDDLES[_COMING[1]]
    found: Array = (_box_distance(local, BOX_HALVES[_COMING[1]]) - balls.radii).min(axis=1)
    return found


def open_rooms(hands: Array, balls: Balls) -> Array:
    """(n,) distances (m) between balls and the open gripper at poses (n, 7), negative inside."""
    turns = Rotation.from_quat(hands[:, 3:]).as_matrix()
    local = (balls.centers[None] - hands[:, None, :3]) @ turns
    boxes = zip(BOX_MIDDLES, BOX_HALVES, strict=True)
    least = [(_box_distance(local - middle, half) - balls.radii).min(axis=1) for middle, half in boxes]
    found: Array = np.min(least, axis=0)
    return found


def between_pads(hands: Array, points: Array) -> npt.NDArray[np.int_]:
    """(n,) how many of the points (k, 3) are between the pads of open grippers at poses (n, 7)."""
    turns = Rotation.from_quat(hands[:, 3:]).as_matrix()
    local = (points[None] - hands[:, None, :3]) @ turns
    found: npt.NDArray[np.int_] = (np.abs(local - _BETWEEN[0]) < _BETWEEN[1]).all(axis=-1).sum(axis=1)
    return found


def rooms(hands: Array, balls: Balls, sweep: float = 0.0, flange: bool = True) -> Array:
    """(n,) distances (m) between balls and a gripper that closes at poses (n, 7) of the hand link, negative inside.

    What lies between the open fingers counts as touched.

    Args:
        hands: Poses in the balls' frame.
        balls: The person's hand.
        sweep: Length of a straight way along the gripper's z axis that ends at the pose and counts too (m).
        flange: Whether the flange behind the hand counts.
    """
    turns = Rotation.from_quat(hands[:, 3:]).as_matrix()
    local = (balls.centers[None] - hands[:, None, :3]) @ turns
    back = np.array([0.0, 0.0, 0.5 * sweep])
    found = _box_distance(local - _CLOSING[0], _CLOSING[1])
    for box in _COMING if flange else _COMING[:1]:
        found = np.minimum(found, _box_distance(local - BOX_MIDDLES[box] + back, BOX_HALVES[box] + back))
    least: Array = (found - balls.radii).min(axis=1)
    return least


def nearest(hand: Array, balls: Balls) -> Nearest:
    """The nearest points of a gripper at one pose (7,) of the hand link and of balls."""
    turn = Rotation.from_quat(hand[3:]).as_matrix()
    local = (balls.centers - hand[:3]) @ turn
    away = local[None] - BOX_MIDDLES[:, None]
    distances = np.stack([_box_distance(way, half) for way, half in zip(away, BOX_HALVES, strict=True)])
    box, ball = np.unravel_index(int(np.argmin(distances - balls.radii)), distances.shape)
    on_box = np.clip(away[box, ball], -BOX_HALVES[box], BOX_HALVES[box]) + BOX_MIDDLES[box]
    way = on_box - local[ball]
    length = float(np.linalg.norm(way))
    # A ball's middle within the box has no nearest face that is worth following; out by the middle instead.
    way = way / length if length > _FACING else -away[box, ball] / max(float(np.linalg.norm(away[box, ball])), _FACING)
    room = float(distances[box, ball] - balls.radii[ball])
    return Nearest(room, hand[:3] + turn @ on_box, turn @ way, int(ball))


def _box_distance(points: Array, half: Array) -> Array:
    """(...) distances of points (..., 3) to a box about the origin, negative inside."""
    beyond = np.abs(points)
    beyond -= half
    # Coordinate by coordinate and in place: NumPy reduces short axes slowly, and this is done for many at once.
    inside = np.minimum(np.maximum(np.maximum(beyond[..., 0], beyond[..., 1]), beyond[..., 2]), 0.0)
    outside = np.maximum(beyond, 0.0, out=beyond)
    found: Array = np.sqrt(np.einsum("...i,...i->...", outside, outside)) + inside
    return found
