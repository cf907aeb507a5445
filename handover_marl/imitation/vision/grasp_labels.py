"""What grasps of an object are worth beside a person's hand: what networks that look at views are to tell.

A grasp's price is that by which the receiver `reactive` chooses, without what depends on the arm: how well it held when
it was tried out, how well the pads have the object, and the room beside the hand. Where the hand leaves little room,
displaced copies of grasps count, too, at the price that they have there.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from handover_marl.models.meshes import model_triangles
from handover_marl.planning.gripper_room import Balls, flange_rooms, rooms, surface_balls
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive.displaced import displaced
from handover_marl.receivers.reactive.grasps import TriedGrasps
from handover_marl.receivers.reactive.grips import grips, looseness, spread_points
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig
from handover_marl.receivers.reactive.trials import tried_grasps

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LabelConfig:
    """How prices become qualities.

    Attributes:
        scale: A grasp of this price has quality 1/e (s).
        least_room: With less room beside the hand its quality is 0 (m).
        worth: Grasps below this quality are not told of.
        displaced: So many displaced grasps at most are looked at beside a hand.
        receiver: Whose prices.
    """

    scale: float = 3.0
    least_room: float = 0.003
    worth: float = 0.02
    displaced: int = 120
    receiver: ReactiveConfig = field(default_factory=ReactiveConfig)


@dataclass(frozen=True, eq=False)
class KnownGrasps:
    """An object's grasps.

    Attributes:
        poses: (n, 7) of the hand link in the object's frame.
        prices: (n,) without a hand beside it (s).
        middle: (3,) of the object, in its frame (m).
    """

    poses: Array
    prices: Array
    middle: Array


class GraspLabels:
    """Grasps of objects, tried out when they are first asked for.

    Args:
        context: The robot, the objects and their grasps.
        config: How prices become qualities.
    """

    def __init__(self, context: PolicyContext, config: LabelConfig = LabelConfig()) -> None:
        self._context, self.config = context, config
        self._grasps = ObjectGrasps(context.grasps)
        self._known: dict[str, KnownGrasps] = {}
        self._tried: dict[str, tuple[TriedGrasps, Array]] = {}

    def of(self, object_name: str) -> KnownGrasps:
        """The grasps of an object class; none for a class that has none by design.

        Raises:
            DataNotFoundError, SimulationError: Its files are missing or cannot be read.
        """
        if object_name not in self._known:
            self._known[object_name] = self._look_up(object_name)
        return self._known[object_name]

    def beside(self, object_name: str, hand: Balls | None, object_pose: Array) -> KnownGrasps:
        """The grasps of an object class, and displaced ones that a hand leaves room for.

        Args:
            object_name: Its class.
            hand: The person's hand in the world, or None.
            object_pose: (7,) pose of the object in the world.
        """
        known, config = self.of(object_name), self.config.receiver
        if hand is None or not len(known.poses):
            return known
        seen, standoff = hand.seen_from(object_pose), config.approach.standoff
        tried, points = self._tried[object_name]
        more = displaced(tried, points, seen, standoff, config.displacements)
        inside = grips(more.poses, points)
        prices = config.grasps.untried + looseness(more, inside, config.grasps)
        good = inside > config.grasps.bare_inside
        kept = np.flatnonzero(good & (self._quality(prices, rooms(more.poses, seen, standoff)) > self.config.worth))
        kept = kept[:: max(1, -(-len(kept) // self.config.displaced))]
        return KnownGrasps(
            np.concatenate([known.poses, more.poses[kept]]), np.concatenate([known.prices, prices[kept]]), known.middle
        )

    def qualities(self, known: KnownGrasps, hand: Balls | None, object_pose: Array) -> Array:
        """(n,) qualities, 0 to 1, of an object's grasps beside a hand in the world.

        Args:
            known: They.
            hand: The person's hand in the world, or None.
            object_pose: (7,) pose of the object in the world.
        """
        if hand is None or not len(known.poses):
            return np.exp(-known.prices / self.config.scale)
        standoff = self.config.receiver.approach.standoff
        return self._quality(known.prices, rooms(known.poses, hand.seen_from(object_pose), standoff))

    def _quality(self, prices: Array, room: Array) -> Array:
        """(n,) qualities of grasps at prices (n,) without a hand, which have room (n,) beside one."""
        costs = self.config.receiver.grasps
        prices = prices + costs.lack * np.maximum(0.0, costs.room - room)
        return np.where(room < self.config.least_room, 0.0, np.exp(-prices / self.config.scale))

    def _look_up(self, object_name: str) -> KnownGrasps:
        urdf, config = self._context.object_urdf(object_name), self.config.receiver
        vertices, faces = model_triangles(urdf)
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        known = self._grasps.in_object(object_name)
        if known is None:
            return KnownGrasps(np.zeros((0, 7)), np.zeros(0), middle)
        tried = tried_grasps(urdf, self._context.panda_urdf, known, config.trials)
        clear = flange_rooms(tried.poses, surface_balls(vertices, faces, config.surface, config.surface_radius)) > 0.0
        tried = TriedGrasps(tried.poses[clear], tried.holds[clear])
        points = spread_points(vertices, faces, config.points)
        self._tried[object_name] = tried, points
        return KnownGrasps(tried.poses, looseness(tried, grips(tried.poses, points), config.grasps), middle)
