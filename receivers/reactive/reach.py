"""The reactive receiver's way to a grasp: to a standoff first, then straight on, with the object as it moves."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import TIME_STEP
from handover_marl.models.poses import IDENTITY, compose, rotation_angle
from handover_marl.policies.policy import Action
from handover_marl.receivers.reactive.choice import Choice, ReactiveChoice, Situation
from handover_marl.receivers.reactive.reactive_config import ApproachConfig
from handover_marl.receivers.reactive.reactive_motion import Motion
from handover_marl.receivers.reactive.reactive_view import View

Array = npt.NDArray[np.float64]

_STEPS = 8
# How much a radian counts against a metre where the arm follows what moves.
TURN_WEIGHT = 0.1
# What is left of a way must shrink to this share of it for progress.
_PROGRESS = 0.95


class Reach:
    """One way after the other, until the fingers may close.

    Args:
        view: What is seen.
        motion: How it moves.
        choice: Which grasp.
        config: The last centimetres.
        period: Between choices (s).

    Attributes:
        near: Whether it is on the straight way already.
    """

    def __init__(
        self, view: View, motion: Motion, choice: ReactiveChoice, config: ApproachConfig, period: float
    ) -> None:
        self._view, self._motion, self._choice, self._config, self._period = view, motion, choice, config, period
        self.near = False
        self._chose_at = -np.inf
        self._left, self._left_at = np.inf, 0.0
        self._way, self._way_at = np.zeros(3), -np.inf

    def step(self) -> Action | Choice:
        """The next action; or the grasp at which the fingers are to close now."""
        choice = self._chosen()
        if choice is None:
            self.near = False
            return self._motion.home_apart()
        config, view = self._config, self._view
        way, loose = self._choice.offset(choice, view.object, view.hand), view.looseness
        # The fingers close along y, and draw what is between them into the middle.
        axial, aside, turn = -float(way[2]), float(np.hypot(way[0], way[1] / loose)), _angle(way)
        beside = config.beside if axial > config.fixed else config.fixed_beside
        self.near = axial < config.standoff + config.near and aside < beside and turn < config.turned
        if not self.near:
            self._watch_progress(float(np.abs(choice.standoff - view.joints).max()))
            return self._motion.transit(choice.standoff if choice.via is None else choice.via)
        self._watch_progress(axial + aside)
        there = abs(axial) < loose * config.close_axial and aside < loose * config.lateral
        if self._speed(way[:3]) < loose * config.close_speed and there and turn < loose * config.turn:
            return choice
        return self._straight_on(choice, self._depth(axial, aside, turn))

    def _speed(self, way: Array) -> float:
        """Of the object (m/s); of one that hovers, beside the gripper, which is at offset (3,) from the grasp."""
        view, before = self._view, self._way
        since = view.time - self._way_at
        self._way, self._way_at = way, view.time
        if view.looseness > 1.0 and 0.0 < since < 2.0 * self._period:
            return float(np.linalg.norm(way - before)) / since
        return view.offer.speed

    def _chosen(self) -> Choice | None:
        """The grasp to go for; the one chosen last while the fingers are about to reach it."""
        config, view, chosen = self._config, self._view, self._choice.chosen
        if chosen is not None:
            way = self._choice.offset(chosen, view.object, view.hand)
            beside = float(np.hypot(way[0], way[1])) < config.fixed_beside
            if -way[2] < config.fixed and beside and _angle(way) < config.fixed_turned:
                return chosen
        if view.time - self._chose_at < self._period - TIME_STEP:
            return chosen
        self._chose_at = view.time
        situation = Situation(
            view.time, view.joints, view.object, view.offer.offered(), view.person.balls, view.settled
        )
        found = self._choice.update(situation, self.near)
        if found is None or chosen is None or found.number != chosen.number:
            self._left, self._left_at = np.inf, view.time
        return found

    def _depth(self, axial: float, aside: float, turn: float) -> float:
        """How far before the grasp to be next (m)."""
        config, offer, loose = self._config, self._view.offer, self._view.looseness
        before, moving = max(axial, 0.0), offer.speed
        fits = aside < loose * (config.lateral + config.funnel * before)
        fits &= turn < loose * (config.turn + config.turn_funnel * before)
        if fits and moving < (config.hover_speed if offer.hovers else config.object_speed):
            period = self._motion.servo.period
            half = 0.5 * config.braking * period
            speed = min(config.speed, float(np.sqrt(half**2 + 2.0 * config.braking * before)) - half)
            return max(0.0, before - speed * period)
        if fits and axial < config.standoff and moving < 2.0 * config.object_speed:
            return before
        within = axial < 0.5 * config.fixed and aside < config.within
        return axial if within and loose == 1.0 else config.standoff

    def _straight_on(self, choice: Choice, depth: float) -> Action:
        """Go to a depth before the grasp, and with it as the object moves."""
        config, view, arm = self._config, self._view, self._motion.arm
        pose = compose(self._choice.grasp(choice, view.object), np.array([0.0, 0.0, -depth, 0.0, 0.0, 0.0, 1.0]))
        # A little way to where the choice found that it can be reached: from the present joints limits may be in the
        # way, and to go there at once would swing the hand aside.
        share = depth / config.standoff
        drawn = choice.goal + share * (choice.standoff - choice.goal) - view.joints
        most = config.drawn / max(float(np.abs(drawn).max()), config.drawn)
        goal, _ = arm.solve(pose[None], (view.joints + most * drawn)[None], _STEPS)
        velocity = config.gain * (goal[0] - view.joints)
        velocity *= min(1.0, config.joint_speed / max(float(np.abs(velocity).max()), 1e-9))
        period = self._motion.servo.period
        linear, angular = view.offer.twist(pose[:3], period)
        return self._motion.last_way(velocity + arm.velocity(view.joints, linear, angular, TURN_WEIGHT, period))

    def _watch_progress(self, left: float) -> None:
        """Give up a grasp that does not come nearer."""
        time = self._view.time
        if left < _PROGRESS * self._left or not self._view.settled:
            self._left, self._left_at = left, time
        elif time - self._left_at > self._config.stall:
            self._choice.give_up(time + self._config.ban)


def _angle(offset: Array) -> float:
    """Angle (rad) of the turn of a pose (7,)."""
    return rotation_angle(offset[3:], IDENTITY[3:])
