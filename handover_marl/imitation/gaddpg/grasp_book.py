"""The grasps to choose goals from, and what each costs from where a hand is."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT
from handover_marl.models.meshes import model_triangles
from handover_marl.models.panda import HALF_TURN
from handover_marl.models.poses import compose
from handover_marl.planning.grasp_rules import usable
from handover_marl.planning.gripper_room import Balls, corners, flange_rooms, rooms, surface_balls
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive.grasps import GraspTrials, TriedGrasps
from handover_marl.receivers.reactive.grips import grips, looseness, spread_points
from handover_marl.receivers.reactive.reactive_config import GraspCosts
from handover_marl.receivers.reactive.trials import tried_grasps

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PriceConfig:
    """What grasps cost, in metres of way.

    Attributes:
        tried: Whether grasps are tried out in simulation and moved on first (20 to 90 s an object, once); else the
            known ones are taken as they are.
        trials: How they are tried out.
        pads: From the hand's origin to the middle between its pads (m), whose way counts.
        turn: Price of a turn of the hand (m/rad).
        loose: What a grasp that holds loosely costs `reactive` (s), and
        pace: metres for each second of it (m/s).
        room: Room that is wanted beside what hides the object (m), on
        sweep: the last part of the way (m), too, and
        lack: price of each metre of it that is missing.
        table: Room above the table (m), and
        low: price of a grasp with less.
    """

    tried: bool = True
    trials: GraspTrials = field(default_factory=GraspTrials)
    pads: float = 0.1
    turn: float = 0.15
    loose: GraspCosts = field(default_factory=GraspCosts)
    pace: float = 0.1
    room: float = 0.01
    sweep: float = 0.08
    lack: float = 20.0
    table: float = 0.005
    low: float = 3.0


@dataclass(frozen=True, eq=False)
class PricedGrasps:
    """Grasps of one object: (n, 7) poses of the hand link in its frame, each in both turns, and (n,) prices (m)."""

    poses: Array
    prices: Array


class GraspBook:
    """Knows the grasps of objects.

    Args:
        context: Knows what is known of them; they are tried out with its robot's fingers.
        config: What they cost.
    """

    def __init__(self, context: PolicyContext, config: PriceConfig) -> None:
        self._context, self._config = context, config
        self._known = ObjectGrasps(context.grasps)
        self._books: dict[str, PricedGrasps | None] = {}

    def of(self, object_name: str) -> PricedGrasps | None:
        """The grasps of a class, or None if it has none.

        Raises:
            SimulationError: The object's model cannot be loaded.
        """
        if object_name not in self._books:
            self._books[object_name] = self._priced(object_name)
        return self._books[object_name]

    def prices(self, grasps: PricedGrasps, world: Array, hand: Array, ball: Array) -> Array:
        """(n,) what grasps cost from where a hand is (m).

        Args:
            grasps: They.
            world: (n, 7) their poses in the world.
            hand: (7,) where the hand is.
            ball: (4,) middle and radius of what hides the object (m); radius 0 is nothing.
        """
        config = self._config
        price: Array = grasps.prices + way_prices(hand, world, config.pads, config.turn)
        behind = compose(world, np.array([0.0, 0.0, -config.sweep, 0.0, 0.0, 0.0, 1.0]))
        heights = np.minimum(*(corners(poses)[..., 2].min(axis=1) for poses in (world, behind)))
        price += config.low * (heights < TABLE_HEIGHT + config.table)
        if ball[3] > 0.0:
            room = rooms(world, Balls(ball[None, :3], ball[3:]), config.sweep)
            price += config.lack * np.maximum(0.0, config.room - room)
        return price

    def _priced(self, name: str) -> PricedGrasps | None:
        config, known = self._config, self._known.in_object(name)
        if known is None:
            return None
        urdf = self._context.object_urdf(name)
        tried = TriedGrasps(known, np.ones(len(known)))
        if config.tried:
            tried = tried_grasps(urdf, self._context.panda_urdf, known, config.trials)
        vertices, faces = model_triangles(urdf)
        clear = flange_rooms(tried.poses, surface_balls(vertices, faces, 150, 0.004)) > 0.0
        clear &= usable(name, compose(tried.poses, np.array(HALF_TURN))) | config.tried
        poses, holds = tried.poses[clear], tried.holds[clear]
        if not len(poses):
            return None
        held = grips(poses, spread_points(vertices, faces, 2000))
        prices = config.pace * looseness(TriedGrasps(poses, holds), held, config.loose)
        both = np.concatenate([poses, compose(poses, np.array(HALF_TURN))])
        return PricedGrasps(both, np.concatenate([prices, prices]))


def way_prices(hand: Array, goals: Array, pads: float, turn: float) -> Array:
    """(n,) ways of the pads and prices of turns from a hand (7,) to goals (n, 7) (m)."""
    to_pads = np.array([0.0, 0.0, pads, 0.0, 0.0, 0.0, 1.0])
    ways = np.linalg.norm(compose(goals, to_pads)[:, :3] - compose(hand, to_pads)[:3], axis=1)
    turns = (Rotation.from_quat(hand[3:]).inv() * Rotation.from_quat(goals[:, 3:])).magnitude()
    found: Array = ways + turn * turns
    return found
