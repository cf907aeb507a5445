"""Which grasp the reactive receiver goes for, and when it changes its mind."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import TABLE_HEIGHT
from handover_marl.models.panda import HALF_TURN, WAITING_JOINTS
from handover_marl.models.poses import compose, compose_point, inverse
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_rods import lowest, rod_rooms
from handover_marl.planning.detours import detour, way_free
from handover_marl.planning.gripper_room import Balls, corners, flange_rooms, rooms
from handover_marl.receivers.reactive.displaced import Displacements, displaced
from handover_marl.receivers.reactive.grasps import TriedGrasps
from handover_marl.receivers.reactive.grips import Graspable, grips, looseness
from handover_marl.receivers.reactive.reactive_config import GraspCosts

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int_]

HOME = np.array(WAITING_JOINTS[:7])
#: Where searches for joints start, and where they also start when nothing was found from there: a greedy cover of what
#: can be reached from the waiting pose in little time.
SEEDS = np.array(
    [
        HOME,
        (-0.386, 0.559, 0.048, -2.175, -1.173, 1.994, 0.797),
        (0.276, 0.693, 0.397, -2.782, 1.358, 2.557, -0.02),
    ]
)
MORE_SEEDS = np.array(
    [
        (0.641, -1.612, -0.197, -2.53, -0.095, 1.678, 0.587),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 1.678, -0.913),
        (-0.059, -1.612, -1.097, -2.53, -0.095, 1.678, 0.587),
        (0.7, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 0.878, 0.587),
        (2.0, 0.23, -2.85, -1.69, 0.056, 1.46, -1.27),
    ]
)

_ROOMY = 0.2  # m, where there is no hand
# A price that no other sum of prices reaches: not to be taken.
_NEVER = 100.0
# After so many pages without one within reach only every so manieth decision looks for one.
_PAGES, _SELDOM = 40, 10
_STANDOFF_STEPS, _GRASP_STEPS = 12, 6


@dataclass(frozen=True, eq=False)
class Choice:
    """A grasp to go for.

    Attributes:
        number: Of the grasp.
        standoff: (7,) joints at its standoff.
        goal: (7,) joints at the grasp.
        via: (7,) joints to go to first, since something is in the straight way to the standoff, or None.
    """

    number: int
    standoff: Array
    goal: Array
    via: Array | None = None


@dataclass(frozen=True, eq=False)
class Situation:
    """What a choice depends on.

    Attributes:
        time: Since the start of the episode (s).
        joints: (7,) where the arm is (rad).
        now: (7,) pose of the object.
        offered: (7,) pose at which it will be held out.
        hand: The person's hand, or None.
        settled: Whether the object rests, or hovers.
    """

    time: float
    joints: Array
    now: Array
    offered: Array
    hand: Balls | None
    settled: bool


class ReactiveChoice:
    """Remembers the grasp chosen last, and those that failed.

    Args:
        arm: The arm.
        speeds: (7,) speeds of its joints (rad/s).
        costs: Prices.
        standoff: Distance of a standoff from its grasp (m).
        period: Time between choices (s).
        displacements: Copies of grasps for when there is none with room.

    Attributes:
        grasps: (n, 7) poses of the hand link in the object's frame to choose from, each in both turns.
        chosen: The grasp chosen last, or None.
        trouble: Why there is none, in a word.
        failed: Numbers of grasps that failed in this episode, and until when they cost more (s).
    """

    def __init__(
        self,
        arm: ArmInWorld,
        speeds: Array,
        costs: GraspCosts,
        standoff: float,
        period: float,
        displacements: Displacements,
    ) -> None:
        self._arm, self._speeds, self._costs, self._period = arm, speeds, costs, period
        self._displacements = displacements
        self._standoff = np.array([0.0, 0.0, -standoff, 0.0, 0.0, 0.0, 1.0])
        self._length = standoff
        self._home_turn = Rotation.from_quat(arm.hand(HOME)[3:])
        self.forget()

    def forget(self) -> None:
        """Forget everything; there is nothing to choose from."""
        nothing = TriedGrasps(np.zeros((0, 7)), np.zeros(0))
        self.reset(Graspable(nothing, np.zeros(0), Balls(np.zeros((1, 3)), np.zeros(1)), np.zeros((1, 3))))

    def reset(self, graspable: Graspable) -> None:
        """Forget everything; choose from the grasps of this object from now on."""
        self._surface, self._points = graspable.surface, graspable.points
        tried = graspable.tried
        clear = flange_rooms(tried.poses, graspable.surface) > 0.0
        self._tried = TriedGrasps(tried.poses[clear], tried.holds[clear])
        self.grasps, self._loose = np.zeros((0, 7)), np.zeros(0)
        self._add(self._tried, graspable.grips[clear], 0.0)
        self.chosen: Choice | None = None
        self.trouble = ""
        self.failed: dict[int, float] = {}
        self._page, self._without, self._waited = 0, 0.0, 0.0
        self._displaced = False

    def _add(self, tried: TriedGrasps, inside: Array, price: float) -> None:
        """Choose from these too, in both turns; (n,) tells how well on the pads they have the object (m)."""
        loose = price + looseness(tried, inside, self._costs)
        self.grasps = np.concatenate([self.grasps, tried.poses, compose(tried.poses, np.array(HALF_TURN))])
        self._loose = np.concatenate([self._loose, loose, loose])

    def offer(self, poses: Array, prices: Array, surface: Balls, chosen: int | None) -> None:
        """Choose from other grasps from now on; those that failed have to be told apart by their prices.

        Args:
            poses: (n, 7) of the hand link in the object's frame.
            prices: (n,) of how loosely they hold (s).
            surface: The object.
            chosen: Which of them is the one chosen last, in the same turn; None forgets it.
        """
        self._surface, self.failed = surface, {}
        self.grasps, self._loose = poses, prices
        if self.chosen is not None:
            self.chosen = None if chosen is None else replace(self.chosen, number=chosen)

    def give_up(self, until: float) -> None:
        """Leave the chosen grasp alone until a time (s), unless there is no other."""
        if self.chosen is not None:
            self.failed[self.chosen.number] = until
        self.chosen = None

    def update(self, situation: Situation, near: bool = False) -> Choice | None:
        """The grasp to go for now: the one of before unless another is better by more than the margin.

        Args:
            situation: As it is.
            near: Whether the gripper is before the grasp of before already; the margin is wider then.
        """
        if self._waited > self._costs.waiting and not self._displaced and situation.hand is not None:
            self._displace(situation.hand.seen_from(situation.now))
        if self._displaced and self._page > _PAGES and self._page % _SELDOM:
            # All has been looked at: nothing but a hand that moves on can help.
            self._page += 1
            return None
        world = compose(situation.offered, self.grasps)
        room = self._rooms(situation)
        rough = self._rough(world, room, situation.time)
        numbers = self._candidates(rough)
        if not len(numbers):
            self._nothing("no room", situation.settled, 1.0)
            return None
        standoffs, goals, found = self._reach(world[numbers], situation.joints)
        prices = rough[numbers] + self._travel(standoffs, situation.joints) + self._tightness(standoffs, goals)
        bodies = self._bodies(situation)
        found &= self._arm_clear(goals, bodies)
        prices[~found] += _NEVER
        old = None if self.chosen is None else int(np.flatnonzero(numbers == self.chosen.number)[0])
        best = int(np.argmin(prices)) if near else self._look_at_ways(prices, standoffs, old, situation.joints, bodies)
        if prices[best] >= _NEVER:
            self._page += 1
            self._nothing("out of reach", situation.settled, self._costs.search)
            return None
        margin = self._costs.gain + (self._costs.near_gain if near else 0.0)
        if self.chosen is not None and self.chosen.via is not None:
            margin += self._costs.blocked
        if old is not None and prices[old] < min(prices[best] + margin, _NEVER):
            best = old
        number = int(numbers[best])
        self._page, self.trouble = 0, ""
        self._waited += self._period if self._loose[number] > self._costs.poor else 0.0
        via = None if near else self._via(standoffs[best], situation.joints, bodies)
        self.chosen = Choice(number, standoffs[best], goals[best], via)
        return self.chosen

    def _look_at_ways(self, prices: Array, standoffs: Array, old: int | None, joints: Array, bodies: Balls) -> int:
        """Adds to (n,) prices what is in the ways to (n, 7) standoffs, for the old and the cheapest; the cheapest."""
        looked = set[int]()
        best = int(np.argmin(prices)) if old is None else old
        while best not in looked and len(looked) < self._costs.looks:
            looked.add(best)
            if not way_free(self._arm, joints, standoffs[best], bodies, TABLE_HEIGHT, self._costs.way_room):
                prices[best] += self._costs.blocked
            best = int(np.argmin(prices))
        return best

    def _via(self, standoff: Array, joints: Array, bodies: Balls) -> Array | None:
        """(7,) joints by way of which to go to a standoff, if something is in the straight way and they help."""
        costs = self._costs
        if way_free(self._arm, joints, standoff, bodies, TABLE_HEIGHT, costs.way_room):
            return None
        before = None if self.chosen is None else self.chosen.via
        if before is not None and all(
            way_free(self._arm, start, end, bodies, TABLE_HEIGHT, costs.way_room)
            for start, end in ((joints, before), (before, standoff))
        ):
            return before
        known = np.concatenate([SEEDS, MORE_SEEDS])
        speeds, room = self._speeds, costs.way_room
        return detour(self._arm, joints, standoff, known, speeds, bodies, TABLE_HEIGHT, room, costs.detours)

    def _bodies(self, situation: Situation) -> Balls:
        """The object and the person's hand where the object will be offered."""
        centers, radii = compose_point(situation.offered, self._surface.centers), self._surface.radii
        if situation.hand is None:
            return Balls(centers, radii)
        place = compose(situation.offered, inverse(situation.now))
        hand = compose_point(place, situation.hand.centers)
        return Balls(np.concatenate([centers, hand]), np.concatenate([radii, situation.hand.radii]))

    def _displace(self, hand: Balls) -> None:
        """Choose from displaced grasps, too, which have room beside a hand in the object's frame."""
        more = displaced(self._tried, self._points, hand, self._length, self._displacements)
        inside = grips(more.poses, self._points)
        held = inside > self._costs.bare_inside
        self._add(TriedGrasps(more.poses[held], more.holds[held]), inside[held], self._costs.untried)
        self._displaced = True

    def _nothing(self, trouble: str, settled: bool, share: float) -> None:
        if settled:
            self._without += share * self._period
            self._waited += self._period
        self.chosen, self.trouble = None, trouble

    def _rooms(self, situation: Situation) -> Array:
        """(n,) room beside the person's hand (m); as hand and object are now, since they move together."""
        if situation.hand is None:
            return np.full(len(self.grasps), _ROOMY)
        return rooms(self.grasps, situation.hand.seen_from(situation.now), self._length)

    def _rough(self, world: Array, room: Array, time: float) -> Array:
        """(n,) prices as far as they need no inverse kinematics."""
        costs = self._costs
        turns = (self._home_turn.inv() * Rotation.from_quat(world[:, 3:])).magnitude()
        rough: Array = self._loose + costs.turn * turns + costs.lack * np.maximum(0.0, costs.room - room)
        rough[room < max(costs.bare_room, costs.least_room - costs.patience * self._without)] += _NEVER
        heights = np.minimum(*(corners(poses)[..., 2].min(axis=1) for poses in (world, compose(world, self._standoff))))
        rough[heights < TABLE_HEIGHT + costs.table] += _NEVER
        for number, until in self.failed.items():
            if time < until:
                rough[number] += costs.failed
        return rough

    def _candidates(self, rough: Array) -> Numbers:
        """The cheapest; others in turn while none of these can be reached; and the one chosen last."""
        order = np.argsort(rough, kind="stable")
        order = order[rough[order] < _NEVER]
        count = self._costs.candidates * (self._costs.wider if self._displaced else 1)
        numbers = np.roll(order, -self._page * count)[:count]
        if len(numbers) and self.chosen is not None and self.chosen.number not in numbers:
            numbers = np.append(numbers, self.chosen.number)
        return numbers

    def _reach(self, grasps: Array, joints: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """(n, 7) joints at the standoffs and at the grasps, from the seed that is nearest to the arm, and whether."""
        seeds = np.concatenate([SEEDS, MORE_SEEDS]) if self._page else SEEDS
        if self.chosen is not None:
            # What was found from a seed that is not looked at every time must not be lost again.
            seeds = np.concatenate([self.chosen.standoff[None], seeds])
        count, copies = len(grasps), len(seeds)
        poses = np.tile(grasps, (copies, 1))
        standoffs, found = self._arm.solve(
            compose(poses, self._standoff), np.repeat(seeds, count, axis=0), _STANDOFF_STEPS
        )
        goals, straight = self._arm.solve(poses, standoffs, _GRASP_STEPS)
        found &= straight & (np.abs(goals - standoffs).max(axis=1) < self._costs.longest_way)
        travel = np.where(found, self._travel(standoffs, joints), np.inf).reshape(copies, count)
        best = np.argmin(travel, axis=0) * count + np.arange(count)
        return standoffs[best], goals[best], found[best]

    def _arm_clear(self, goals: Array, bodies: Balls) -> npt.NDArray[np.bool_]:
        """(n,) whether elbow, forearm and wrist keep clear of hand and object at the grasps."""
        beside = rod_rooms(self._arm, goals, bodies) > self._costs.arm_room
        found: npt.NDArray[np.bool_] = beside & (lowest(self._arm, goals) > TABLE_HEIGHT + self._costs.table)
        return found

    def _travel(self, standoffs: Array, joints: Array) -> Array:
        """(n,) time to the standoffs (s)."""
        time: Array = (np.abs(standoffs - joints) / self._speeds).max(axis=1)
        return time

    def _tightness(self, standoffs: Array, goals: Array) -> Array:
        low, high = self._arm.limits
        edge = np.minimum(*(np.minimum(joints - low, high - joints).min(axis=1) for joints in (standoffs, goals)))
        price: Array = self._costs.tight * np.maximum(0.0, self._costs.limit - edge)
        return price

    def grasp(self, choice: Choice, obj: Array) -> Array:
        """(7,) pose of the hand link at a grasp of the object at pose (7,)."""
        pose: Array = compose(obj, self.grasps[choice.number])
        return pose

    def standoff(self, grasp: Array) -> Array:
        """(7,) pose of the hand link before a grasp at pose (7,)."""
        return compose(grasp, self._standoff)

    def offset(self, choice: Choice, obj: Array, hand: Array) -> Array:
        """(7,) pose of the hand link at (7,) in the frame of the grasp of the object at (7,)."""
        pose: Array = compose(inverse(self.grasp(choice, obj)), hand)
        return pose
