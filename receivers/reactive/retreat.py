"""Taking an object away: out of the person's hand first, then to the goal."""

import itertools

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.poses import IDENTITY, compose_point, inverse_transform_points, rotate
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_servo import ArmServo
from handover_marl.planning.gripper_room import Balls, rooms
from handover_marl.receivers.reactive.choice import HOME, SEEDS
from handover_marl.receivers.reactive.reactive_config import RetreatConfig

Array = npt.NDArray[np.float64]

_DIRECTIONS = np.array(
    [np.array(way) / np.linalg.norm(way) for way in itertools.product((-1, 0, 1), repeat=3) if any(way)]
)
_TURN_SHARES = (0.0, 0.25, 0.5, 1.0)
# Shares of the way at which it is looked whether it is free.
_LOOKS = np.array([0.35, 0.7, 1.0])
# Column, upper arm and forearm as balls along the lines between the base, the shoulder, the elbow and the wrist (m).
_RADII = np.array([0.1, 0.09, 0.075])
_BALLS = 6
_SHOULDER, _ELBOW, _WRIST = 1, 3, 4
_STEPS, _TOLERANCE = 12, 5e-3
_FAR = 1000.0


class Retreat:
    """One retreat.

    Args:
        arm: The arm.
        servo: Its speeds.
        goal: (3,) where the hand is to come (m).
        config: How.
        start: (7,) pose of the hand link when the person let go.
        held: (k, 3) points of the object in the hand's frame (m).
        person: The person's hand, or None.
    """

    def __init__(
        self,
        arm: ArmInWorld,
        servo: ArmServo,
        goal: Array,
        config: RetreatConfig,
        start: Array,
        held: Array,
        person: Balls | None,
    ) -> None:
        self._arm, self._servo, self._goal, self._config = arm, servo, goal, config
        self._start, self._held, self._person = start, held, person
        self._back = -rotate(start[3:], np.array([0.0, 0.0, 1.0]))
        self._share, self._speed = 0.0, 0.0
        self._joints: Array | None = None
        self._blocked: list[Array] = []
        self._left, self._left_at = np.inf, 0.0
        self._begun: float | None = None

    def velocity(self, time: float, joints: Array, hand: Array) -> Array:
        """(7,) joint velocities (rad/s) at a time (s), for the arm at (7,) with its hand at pose (7,)."""
        if self._joints is None or self._stuck(time, float(np.abs(joints - self._joints).max())):
            if self._joints is not None:
                self._blocked.append(self._joints)
            self._joints, self._left, self._left_at = self._choose(joints, hand), np.inf, time
        config, period = self._config, self._servo.period
        self._begun = time if self._begun is None else self._begun
        backed = float((hand[:3] - self._start[:3]) @ self._back)
        done = max(backed / config.back, (time - self._begun) / config.back_time)
        self._share = float(np.clip(done, self._share, 1.0))
        self._speed = min(config.speed, self._speed + config.acceleration * period)
        there = self._servo.limited(self._servo.towards(joints, self._joints))
        if self._share >= 1.0:
            return there
        turn = (Rotation.from_quat(self._start[3:]) * Rotation.from_quat(hand[3:]).inv()).as_rotvec()
        out = self._arm.velocity(joints, self._speed * self._back, config.turn_gain * turn, config.turn_weight, period)
        mixed: Array = (1.0 - self._share) * out + self._share * there
        return mixed

    def _stuck(self, time: float, left: float) -> bool:
        if left < self._config.progress * self._left or left < self._config.there:
            self._left, self._left_at = left, time
        return time - self._left_at > self._config.stall

    def _choose(self, joints: Array, hand: Array) -> Array:
        """(7,) joints near the goal that are soonest reached on a free way."""
        here = Rotation.from_quat(hand[3:])
        home = (Rotation.from_quat(self._arm.hand(HOME)[3:]) * here.inv()).as_rotvec()
        turns = [(Rotation.from_rotvec(share * home) * here).as_quat() for share in _TURN_SHARES]
        places = self._goal + self._config.inside * np.concatenate([np.zeros((1, 3)), _DIRECTIONS])
        poses = np.array([[*place, *turn] for place in places for turn in turns])
        seeds = np.concatenate([joints[None], SEEDS])
        found, reached = self._arm.solve(
            np.tile(poses, (len(seeds), 1)), np.repeat(seeds, len(poses), axis=0), _STEPS, _TOLERANCE
        )
        travel = (np.abs(found - joints) / self._servo.limits).max(axis=1)
        travel[~reached] = _FAR
        for other in self._blocked:
            travel[np.abs(found - other).max(axis=1) < self._config.other] += 0.5 * _FAR
        order = np.argsort(travel, kind="stable")
        looks = [n for n in order[: self._config.looks] if travel[n] < 0.5 * _FAR and self._free(joints, found[n])]
        for number in looks:
            if self._passes(joints, found[number]):
                return np.asarray(found[number])
        return np.asarray(found[looks[0] if looks else order[0]])

    def _passes(self, joints: Array, goal: Array) -> bool:
        """Whether the gripper has enough room beside the person's hand on the straight joint way."""
        if self._person is None:
            return True
        hands = self._arm.hands(joints + np.array([0.0, *_LOOKS])[:, None] * (goal - joints))
        room = rooms(hands, self._person)
        return bool(room[1:].min() > min(float(room[0]), self._config.room))

    def _free(self, joints: Array, goal: Array) -> bool:
        """Whether gripper and object keep clear of the arm itself on the straight joint way."""
        line = joints + _LOOKS[:, None] * (goal - joints)
        (links, _), hands = self._arm.frames(line), self._arm.hands(line)
        shares = np.linspace(0.0, 1.0, _BALLS)[:, None, None]
        for origins, hand in zip(links, hands, strict=True):
            foot = np.array([*origins[0, :2], origins[0, 2] - 0.333])
            ends = np.stack([foot, origins[_SHOULDER], origins[_ELBOW], origins[_WRIST]])
            centers = (ends[:-1] + shares * (ends[1:] - ends[:-1])).reshape(-1, 3)
            body = Balls(inverse_transform_points(hand, centers), np.tile(_RADII, _BALLS))
            apart = np.linalg.norm(self._held[:, None] - body.centers, axis=-1) - body.radii
            if apart.min() < 0.0 or rooms(IDENTITY[None], body, flange=False)[0] < 0.0:
                return False
        return True


def held_points(hand: Array, obj: Array, surface: Array) -> Array:
    """(k, 3) points of an object at pose (7,) in the frame of a hand at pose (7,), from points in its own (m)."""
    return inverse_transform_points(hand, compose_point(obj, surface))
