"""How the reactive receiver moves: kept apart from the person's hand, within its motors' limits."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from handover_marl.config import TABLE_HEIGHT
from handover_marl.models.panda import CLOSED, OPEN
from handover_marl.models.poses import compose_point
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_servo import ArmServo
from handover_marl.planning.gripper_room import Balls
from handover_marl.planning.separation import Neighbour, SeparationConfig, separated, slow_enough
from handover_marl.policies.policy import Action
from handover_marl.receivers.reactive.choice import HOME
from handover_marl.receivers.reactive.reactive_view import View

Array = npt.NDArray[np.float64]

_SLOWER = np.array([1.0, 0.6, 0.35, 0.2, 0.1, 0.05, 0.0])


class Motion:
    """Turns joint velocities into actions.

    Args:
        arm: The arm.
        servo: Its motors.
        view: What is seen.
        config: How near it comes to what, and how fast.

    Attributes:
        surface: The object in its own frame.
    """

    def __init__(self, arm: ArmInWorld, servo: ArmServo, view: View, config: SeparationConfig) -> None:
        self.arm, self.servo, self._view, self._config = arm, servo, view, config
        self.surface = Balls(np.zeros((0, 3)), np.zeros(0))

    def home(self) -> Action:
        """Towards the waiting pose, at once."""
        return self.open(self._home())

    def home_apart(self) -> Action:
        """Towards the waiting pose, away from the person's hand."""
        return self.open(self._apart(self._home(), self._config.stop))

    def transit(self, goal: Array) -> Action:
        """Towards joints (7,), past hand and object."""
        return self.open(self._apart(self._towards(goal), self._config.stop, transit=True))

    def last_way(self, velocity: Array) -> Action:
        """With joint velocities (7,), close to hand and object."""
        return self.open(self._apart(velocity, self._config.touch, self._config.last_time))

    def carry(self, velocity: Array) -> Action:
        """With joint velocities (7,), holding the object, out of the person's hand."""
        return self.closed(self._apart(self.servo.limited(velocity), self._config.stop, leaving=True))

    def open(self, velocity: Array) -> Action:
        """With joint velocities (7,) as they are, the fingers open."""
        return self._action(velocity, OPEN, None)

    def closed(self, velocity: Array, acceleration: float | None = None) -> Action:
        """With joint velocities (7,) as they are, the fingers closing."""
        return self._action(velocity, CLOSED, acceleration)

    def _home(self) -> Array:
        return self.servo.towards(self._view.joints, HOME)

    def _towards(self, goal: Array) -> Array:
        return self.servo.limited(self.servo.towards(self._view.joints, goal))

    def _action(self, velocity: Array, fingers: float, acceleration: float | None) -> Action:
        target = self.servo.command(self._view.joints, self.servo.limited(velocity), acceleration)
        return np.array([*target, fingers, fingers], dtype=np.float32)

    def _apart(
        self, velocity: Array, room: float, time: float | None = None, transit: bool = False, leaving: bool = False
    ) -> Array:
        """The velocity, kept apart from the person's hand, and in transit from the object."""
        view, neighbours = self._view, []
        if transit:
            here = Balls(compose_point(view.object, self.surface.centers), self.surface.radii)
            neighbours.append(Neighbour(here, view.offer.latest, self._config.object_stop))
        if view.person.balls is not None:
            neighbours.append(Neighbour(view.person.balls, view.person.velocity, room))
        config = self._config if time is None else replace(self._config, time=time)
        found = separated(velocity, self.arm, view.joints, neighbours, config, leaving)
        slower = _SLOWER[:, None] * self.servo.limited(found)
        reached = self.servo.reached(slower)
        return slow_enough(slower, reached, self.arm, view.joints, neighbours, TABLE_HEIGHT, config)
