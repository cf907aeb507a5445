"""A receiver that moves with the person: follows the object, changes its grasp, keeps clear of the hand.

While the person lifts the object it goes to a standoff before a grasp at the place where the object will be held out.
It closes in on the grasp in a straight line relative to the moving object, closes its fingers once it is there, backs
out and tries again when it held nothing, and, when the person lets go, takes the object out of the hand and to the
goal. It knows the true poses of object and hand, and remembers little: the motion of both, the chosen grasp, and
grasps that failed.
"""

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS, TIME_STEP
from handover_marl.episode.observations import Observation
from handover_marl.errors import ResetNeededError
from handover_marl.models.arm import Arm
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.meshes import model_triangles
from handover_marl.models.panda import CLOSED, LOWER_LIMITS, OPEN, UPPER_LIMITS
from handover_marl.models.poses import compose, compose_point, rotation_angle
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_servo import ArmServo
from handover_marl.planning.gripper_room import Balls, surface_balls
from handover_marl.planning.offer_prediction import OfferPrediction
from handover_marl.planning.person_motion import HandMotion
from handover_marl.planning.separation import Neighbour, separated
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.waiting import wait_ms
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive_choice import HOME, Choice, ReactiveChoice, Situation
from handover_marl.receivers.reactive_config import ReactiveConfig, with_risk
from handover_marl.receivers.reactive_grasps import TriedGrasps, tried_grasps
from handover_marl.receivers.reactive_grips import Graspable, grips, spread_points
from handover_marl.receivers.reactive_retreat import Retreat, held_points

Array = npt.NDArray[np.float64]

_STRAIGHT_STEPS = 8
# How much a radian counts against a metre where an arm follows what moves.
_TURN_WEIGHT = 0.1


class Phase(Enum):
    """What the receiver is doing."""

    WAIT = "wait"
    APPROACH = "approach"
    REACH = "reach"
    CLOSE = "close"
    BACK = "back"
    RETREAT = "retreat"


class ReactiveReceiver(Receiver):
    """See the module.

    Args:
        context: The robot, the objects and their grasps.
        wait: How long to stay at the waiting pose (s).
        risk: Trades success (0) against speed (1).
        config: All constants, for a risk of 0.5.

    Raises:
        OptionError: `wait` or `risk` is out of range.

    Attributes:
        phase: What it is doing.
    """

    name = "reactive"
    control_period = 0.05

    def __init__(
        self, context: PolicyContext, wait: float = 0.0, risk: float = 0.5, config: ReactiveConfig | None = None
    ) -> None:
        super().__init__(context)
        self.config = with_risk(config or ReactiveConfig(), risk)
        self.phase = Phase.WAIT
        self._wait = wait_ms(wait) / 1000.0
        padding = self.config.limit_padding
        limits = np.array(LOWER_LIMITS[:ARM_JOINTS]) + padding, np.array(UPPER_LIMITS[:ARM_JOINTS]) - padding
        base = np.array([*context.panda.base_position, *context.panda.base_orientation])
        self._arm = ArmInWorld(Arm(read_tree(context.panda_urdf)), base, limits)
        self._servo = ArmServo(self.config.servo, context.panda.motor.position_gain, self.config.period, TIME_STEP)
        config_ = self.config
        self.choice = ReactiveChoice(
            self._arm,
            self._servo.limits,
            config_.grasps,
            config_.approach.standoff,
            config_.period,
            config_.displacements,
        )
        self._known = ObjectGrasps(context.grasps)
        self._objects: dict[str, Graspable] = {}
        self._seen: str | None = None
        self._ready = False

    @property
    def wait(self) -> float:
        """How long it stays at the waiting pose (s)."""
        return self._wait

    @property
    def hold_time(self) -> float:
        """Until the next decision; where something near moves, and while the fingers close, it looks more often."""
        return self._servo.period

    @property
    def commanded_velocity(self) -> Array:
        """(7,) joint velocities of the last decision (rad/s)."""
        return self._servo.velocity

    def prepare(self, object_names: Sequence[str]) -> None:
        """Try out grasps of the first object, which is the one that is handed over, or look up what was found."""
        for name in object_names[:1]:
            self._about(name)

    def reset(self, seed: int | None = None) -> None:
        """Forget the episode; nothing here is random."""
        self._servo.reset()
        self._offer, self._person = OfferPrediction(self.config.offer), HandMotion()
        self.phase, self._seen, self._ready = Phase.WAIT, None, True
        self._since = 0.0
        self._left, self._left_at = np.inf, 0.0
        self._chose_at = -np.inf
        self._closing_pose, self._closing_points = np.zeros(7), np.zeros((0, 3))
        self._way, self._way_at = np.zeros(3), -np.inf
        self._way_out = np.zeros(7)
        self._retreat: Retreat | None = None

    def act(self, observation: Observation) -> Action:
        """The next nine target joint positions."""
        self._look(observation)
        if self._time < self._wait:
            return self._move(self._servo.towards(self._joints, HOME), OPEN)
        if self.phase is Phase.WAIT and len(self.choice.grasps) and self._offers():
            self.phase = Phase.APPROACH
        if self.phase in (Phase.APPROACH, Phase.REACH):
            return self._approach()
        if self.phase is Phase.CLOSE:
            return self._close(bool(observation["released"][0]))
        if self.phase is Phase.BACK:
            return self._back_out()
        if self.phase is Phase.RETREAT:
            return self._carry()
        return self._move(self._servo.towards(self._joints, HOME), OPEN)

    def _look(self, observation: Observation) -> None:
        """Take note of what is seen."""
        if not self._ready:
            raise ResetNeededError(f"receiver {self.name!r} was asked to act before reset()")
        joints = observation["robot_joint_position"].astype(np.float64)
        self._time = round(float(observation["time"][0]), 3)
        self._joints, self._fingers = joints[:ARM_JOINTS], joints[ARM_JOINTS:]
        self._hand = self._arm.hand(self._joints)
        self._object = observation["object_poses"][0].astype(np.float64)
        self._offer.see(self._time, self._object)
        self._person.see(self._time, observation)
        self._servo.period = self._period()
        name = CLASS_NAMES[int(observation["object_classes"][0])]
        if name != self._seen:
            self._seen = name
            graspable = self._about(name)
            self._surface = graspable.surface
            self.choice.reset(graspable)

    def _period(self) -> float:
        """Until the next decision (s)."""
        coming = self.phase in (Phase.APPROACH, Phase.REACH)
        near = coming and float(np.linalg.norm(self._object[:3] - self._hand[:3])) < self.config.near
        moving = max(self._offer.speed, self._person.speed) > self.config.near_speed
        return self.config.near_period if near and moving else self.config.period

    def _about(self, name: str) -> Graspable:
        """Grasps and surface of an object class."""
        if name not in self._objects:
            urdf, known = self.context.object_urdf(name), self._known.in_object(name)
            grasps = TriedGrasps(np.zeros((0, 7)), np.zeros(0))
            if known is not None:
                grasps = tried_grasps(urdf, self.context.panda_urdf, known, self.config.trials)
            vertices, faces = model_triangles(urdf)
            surface = surface_balls(vertices, faces, self.config.surface, self.config.surface_radius)
            points = spread_points(vertices, faces, self.config.points)
            self._objects[name] = Graspable(grasps, grips(grasps.poses, points), surface, points)
        return self._objects[name]

    def _offers(self) -> bool:
        """Whether the person hands the object over: it was lifted, or lies still beside a hand that is still."""
        config = self.config
        if self._person.balls is None:
            return self._time > config.alone
        if self._offer.lifted > config.lifted:
            return True
        beside = self._person.distance(self._object[:3]) < config.beside and self._person.speed < config.offer.slow
        return beside and self._offer.rest > config.still and self._time > config.after

    def _approach(self) -> Action:
        choice = self._choose()
        if choice is None:
            self.phase = Phase.APPROACH
            return self._move(self._apart(self._servo.towards(self._joints, HOME), self.config.separation.stop), OPEN)
        config = self.config.approach
        way = self.choice.offset(choice, self._object, self._hand)
        axial, aside, turn = -float(way[2]), float(np.hypot(way[0], way[1])), _angle(way)
        if not (axial < config.standoff + config.near and aside < config.beside and turn < config.turned):
            self.phase = Phase.APPROACH
            self._watch_progress(float(np.abs(choice.standoff - self._joints).max()))
            next_ = choice.standoff if choice.via is None else choice.via
            velocity = self._servo.limited(self._servo.towards(self._joints, next_))
            return self._move(self._apart(velocity, self.config.separation.stop, transit=True), OPEN)
        self.phase = Phase.REACH
        self._watch_progress(axial + aside)
        loose = self._looseness()
        there = abs(axial) < loose * config.close_axial and aside < loose * config.lateral and turn < config.turn
        if self._beside(way[:3]) < loose * config.close_speed and there:
            self.phase, self._since = Phase.CLOSE, self._time
            self._closing_pose = self.choice.grasp(choice, self._object)
            self._closing_points = self._person.points
            return self._close(False)
        return self._straight_on(choice, self._depth(axial, aside, turn))

    def _beside(self, way: Array) -> float:
        """Speed of the object (m/s); of one that hovers, beside the gripper, at offset (3,) from the grasp."""
        since, before = self._time - self._way_at, self._way
        self._way, self._way_at = way, self._time
        if self._looseness() > 1.0 and since < 2.0 * self.config.period:
            return float(np.linalg.norm(way - before)) / since
        return self._offer.speed

    def _looseness(self) -> float:
        """How many times the usual tolerances are enough: one cannot wait for what hovers to rest."""
        return self.config.approach.hover_loose if self._offer.hovers and self._offer.rest == 0.0 else 1.0

    def _choose(self) -> Choice | None:
        """The grasp to go for; the one chosen last while the fingers are about to reach it."""
        config, chosen = self.config.approach, self.choice.chosen
        if chosen is not None:
            way = self.choice.offset(chosen, self._object, self._hand)
            beside = float(np.hypot(way[0], way[1])) < config.fixed_beside
            if -way[2] < config.fixed and beside and _angle(way) < config.fixed_turned:
                return chosen
        if self._time - self._chose_at < self.config.period - TIME_STEP:
            return chosen
        self._chose_at = self._time
        situation = Situation(
            self._time, self._joints, self._object, self._offer.offered(), self._person.balls, self._offer.rest > 0.2
        )
        found = self.choice.update(situation, self.phase is Phase.REACH)
        if found is None or chosen is None or found.number != chosen.number:
            self._left, self._left_at = np.inf, self._time
        return found

    def _depth(self, axial: float, aside: float, turn: float) -> float:
        """How far before the grasp to be next (m)."""
        config, moving = self.config.approach, self._offer.speed
        before = max(axial, 0.0)
        loose = self._looseness()
        fits = aside < loose * (config.lateral + config.funnel * before)
        fits &= turn < loose * (config.turn + config.turn_funnel * before)
        if fits and moving < (config.hover_speed if self._offer.hovers else config.object_speed):
            half = 0.5 * config.braking * self._servo.period
            speed = min(config.speed, float(np.sqrt(half**2 + 2.0 * config.braking * before)) - half)
            return max(0.0, before - speed * self._servo.period)
        if fits and axial < config.standoff and moving < 2.0 * config.object_speed:
            return before
        return config.standoff if axial > 0.5 * config.fixed else axial

    def _straight_on(self, choice: Choice, depth: float) -> Action:
        """Go to a depth before the grasp, and with it as the object moves."""
        config, period = self.config.approach, self._servo.period
        pose = compose(self.choice.grasp(choice, self._object), np.array([0.0, 0.0, -depth, 0.0, 0.0, 0.0, 1.0]))
        # A little way to where the choice found that it can be reached: from the present joints limits may be in the
        # way, and to go there at once would swing the hand aside.
        share = depth / config.standoff
        drawn = choice.goal + share * (choice.standoff - choice.goal) - self._joints
        most = config.drawn / max(float(np.abs(drawn).max()), config.drawn)
        seed = self._joints + most * drawn
        goal, _ = self._arm.solve(pose[None], seed[None], _STRAIGHT_STEPS)
        velocity = config.gain * (goal[0] - self._joints)
        velocity *= min(1.0, config.joint_speed / max(float(np.abs(velocity).max()), 1e-9))
        linear, angular = self._offer.twist(pose[:3], period)
        velocity = velocity + self._arm.velocity(self._joints, linear, angular, _TURN_WEIGHT, period)
        separation = self.config.separation
        return self._move(self._apart(velocity, separation.touch, separation.last_time), OPEN)

    def _watch_progress(self, left: float) -> None:
        """Give up a grasp that does not come nearer."""
        if left < 0.95 * self._left or not (self._offer.rest > 0.2 or self._offer.hovers):
            self._left, self._left_at = left, self._time
        elif self._time - self._left_at > self.config.approach.stall:
            self.choice.give_up(self._time + self.config.approach.ban)

    def _close(self, released: bool) -> Action:
        config = self.config.approach
        if released:
            self.phase = Phase.RETREAT
            held = held_points(self._hand, self._object, self._surface.centers)
            goal = np.array(self.context.protocol.goal_center)
            person = self._person.balls
            self._retreat = Retreat(self._arm, self._servo, goal, self.config.retreat, self._hand, held, person)
            return self._carry()
        since = self._time - self._since
        if since > config.close_time or (since > config.empty_after and float(self._fingers.max()) < config.empty):
            self.choice.give_up(self._time + config.ban)
            self.phase, self._since = Phase.BACK, self._time
            self._way_out = compose(self._hand, np.array([0.0, 0.0, -config.backing, 0.0, 0.0, 0.0, 1.0]))
            return self._back_out()
        # Stay with the person's hand rather than with the object, which the fingers push.
        self._servo.period = config.close_period
        pose = self._person.moved(self._closing_points, self._closing_pose, config.close_period)
        goal, _ = self._arm.solve(pose[None], self._joints[None], _STRAIGHT_STEPS)
        ahead = self._arm.velocity(self._joints, self._person.velocity, np.zeros(3), _TURN_WEIGHT, config.close_period)
        velocity = ahead + config.close_gain * (goal[0] - self._joints)
        return self._move(velocity, CLOSED, config.close_acceleration)

    def _back_out(self) -> Action:
        config = self.config.approach
        since = self._time - self._since
        way = self._way_out[:3] - self._hand[:3]
        left = float(np.linalg.norm(way))
        if left < 0.3 * config.backing or since > config.backing_time:
            self.phase = Phase.APPROACH
            return self._approach()
        if since < config.opening_time:
            return self._move(np.zeros(ARM_JOINTS), OPEN)
        velocity = self._arm.velocity(
            self._joints, config.backing_speed * way / left, np.zeros(3), 0.3, self._servo.period
        )
        return self._move(velocity, OPEN)

    def _carry(self) -> Action:
        if self._retreat is None:
            raise ResetNeededError(f"receiver {self.name!r} has nothing to carry")
        velocity = self._servo.limited(self._retreat.velocity(self._time, self._joints, self._hand))
        return self._move(self._apart(velocity, self.config.separation.stop, leaving=True), CLOSED)

    def _apart(
        self, velocity: Array, room: float, time: float | None = None, transit: bool = False, leaving: bool = False
    ) -> Array:
        """The velocity, kept apart from the person's hand, and in transit from the object."""
        neighbours = []
        if transit:
            here = Balls(compose_point(self._object, self._surface.centers), self._surface.radii)
            neighbours.append(Neighbour(here, self._offer.latest, self.config.separation.object_stop))
        if self._person.balls is not None:
            neighbours.append(Neighbour(self._person.balls, self._person.velocity, room))
        config = self.config.separation if time is None else replace(self.config.separation, time=time)
        return separated(velocity, self._arm, self._joints, neighbours, config, leaving)

    def _move(self, velocity: Array, fingers: float, acceleration: float | None = None) -> Action:
        target = self._servo.command(self._joints, self._servo.limited(velocity), acceleration)
        return np.array([*target, fingers, fingers], dtype=np.float32)


def _angle(offset: Array) -> float:
    """Angle (rad) of the turn of a pose (7,)."""
    return rotation_angle(offset[3:], np.array([0.0, 0.0, 0.0, 1.0]))
