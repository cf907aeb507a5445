"""A receiver that moves with the person: follows the object, changes its grasp, keeps clear of the hand.

While the person lifts the object it goes to a standoff before a grasp at the place where the object will be held out.
It closes in on the grasp in a straight line relative to the moving object, closes its fingers once it is there, backs
out and tries again when it held nothing, and, when the person lets go, takes the object out of the hand and to the
goal. It knows the true poses of object and hand, and remembers little: the motion of both, the chosen grasp, and
grasps that failed.
"""

from collections.abc import Sequence
from enum import Enum

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS, TIME_STEP
from handover_marl.episode.observations import Observation
from handover_marl.errors import ResetNeededError
from handover_marl.models.meshes import model_triangles
from handover_marl.models.poses import compose_point
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.planning.arm_servo import ArmServo
from handover_marl.planning.gripper_room import surface_balls
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.waiting import wait_ms
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive.choice import Choice, ReactiveChoice
from handover_marl.receivers.reactive.grasps import TriedGrasps
from handover_marl.receivers.reactive.grips import Graspable, grips, spread_points
from handover_marl.receivers.reactive.reach import TURN_WEIGHT, Reach
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig, with_risk
from handover_marl.receivers.reactive.reactive_motion import Motion
from handover_marl.receivers.reactive.reactive_view import View
from handover_marl.receivers.reactive.retreat import Retreat, held_points
from handover_marl.receivers.reactive.trials import tried_grasps

Array = npt.NDArray[np.float64]

_STEPS = 8


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
        self.config = config = with_risk(config or ReactiveConfig(), risk)
        self.phase = Phase.WAIT
        self._wait = wait_ms(wait) / 1000.0
        self._arm = ArmInWorld.of_panda(context.panda_urdf, context.panda, config.limit_padding)
        self._servo = ArmServo(config.servo, context.panda.motor.position_gain, config.period, TIME_STEP)
        standoff = config.approach.standoff
        self.choice = ReactiveChoice(
            self._arm, self._servo.limits, config.grasps, standoff, config.period, config.displacements
        )
        self._known = ObjectGrasps(context.grasps)
        self._objects: dict[str, Graspable] = {}
        self._ready = False

    @property
    def wait(self) -> float:
        """How long it stays at the waiting pose (s)."""
        return self._wait

    @property
    def intention(self) -> Array | None:
        """Standoff and grasp, until the fingers close."""
        chosen = self.choice.chosen
        if chosen is None or self.phase not in (Phase.APPROACH, Phase.REACH):
            return None
        grasp = self.choice.grasp(chosen, self._view.object)
        return np.stack([self.choice.standoff(grasp), grasp])

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
        self._view = self._new_view(seed)
        self._motion = Motion(self._arm, self._servo, self._view, self.config.separation)
        self._reach = Reach(self._view, self._motion, self.choice, self.config.approach, self.config.period)
        self.phase, self._seen, self._ready = Phase.WAIT, "", True
        self._since = 0.0
        self._closing_pose, self._closing_points = np.zeros(7), np.zeros((0, 3))
        self._way_out = np.zeros(3)
        self._retreat: Retreat | None = None

    def act(self, observation: Observation) -> Action:
        """The next nine target joint positions."""
        self._look(observation)
        if self._view.time < self._wait:
            return self._motion.home()
        if self.phase is Phase.WAIT and len(self.choice.grasps) and self._view.offered:
            self.phase = Phase.APPROACH
        if self.phase in (Phase.APPROACH, Phase.REACH):
            return self._approach()
        if self.phase is Phase.CLOSE:
            return self._close(self._let_go(observation))
        if self.phase is Phase.BACK:
            return self._back_out()
        if self.phase is Phase.RETREAT:
            return self._carry()
        return self._motion.home()

    def _new_view(self, seed: int | None) -> View:
        """What follows an episode's observations."""
        return View(self._arm, self.config)

    def _let_go(self, observation: Observation) -> bool:
        """Whether the person has let go."""
        return bool(observation["released"][0])

    def _look(self, observation: Observation) -> None:
        """Take note of what is seen."""
        if not self._ready:
            raise ResetNeededError(f"receiver {self.name!r} was asked to act before reset()")
        self._see(observation)
        coming = self.phase in (Phase.APPROACH, Phase.REACH)
        self._servo.period = self.config.near_period if coming and self._view.near_motion else self.config.period

    def _see(self, observation: Observation) -> None:
        """Take note of an observation, and know what to grasp."""
        self._view.see(observation)
        if self._view.object_name != self._seen:
            self._seen = self._view.object_name
            graspable = self._about(self._seen)
            self._motion.surface = graspable.surface
            self.choice.reset(graspable)

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

    def _approach(self) -> Action:
        found, view = self._reach.step(), self._view
        if not isinstance(found, Choice):
            self.phase = Phase.REACH if self._reach.near else Phase.APPROACH
            return found
        self.phase, self._since = Phase.CLOSE, view.time
        self._closing_pose, self._closing_points = self.choice.grasp(found, view.object), view.person.anchor
        return self._close(False)

    def _close(self, released: bool) -> Action:
        config, view = self.config.approach, self._view
        if released:
            self.phase = Phase.RETREAT
            held = held_points(view.hand, view.object, self._motion.surface.centers)
            goal = np.array(self.context.protocol.goal_center)
            self._retreat = Retreat(
                self._arm, self._servo, goal, self.config.retreat, view.hand, held, view.person.balls
            )
            return self._carry()
        since = view.time - self._since
        if since > config.close_time or (since > config.empty_after and float(view.fingers.max()) < config.empty):
            return self._miss()
        # Stay with the person's hand rather than with the object, which the fingers push.
        self._servo.period = config.close_period
        pose = view.person.moved(self._closing_points, self._closing_pose, config.close_period)
        goal, _ = self._arm.solve(pose[None], view.joints[None], _STEPS)
        ahead = self._arm.velocity(view.joints, view.person.velocity, np.zeros(3), TURN_WEIGHT, config.close_period)
        velocity = ahead + config.close_gain * (goal[0] - view.joints)
        return self._motion.closed(velocity, config.close_acceleration)

    def _miss(self) -> Action:
        """Nothing is held: back out, and leave this grasp alone for a while."""
        config, view = self.config.approach, self._view
        self.choice.give_up(view.time + config.ban)
        self.phase, self._since = Phase.BACK, view.time
        self._way_out = compose_point(view.hand, np.array([0.0, 0.0, -config.backing]))
        return self._back_out()

    def _back_out(self) -> Action:
        config, view = self.config.approach, self._view
        since = view.time - self._since
        way = self._way_out - view.hand[:3]
        left = float(np.linalg.norm(way))
        if left < 0.3 * config.backing or since > config.backing_time:
            self.phase = Phase.APPROACH
            return self._approach()
        if since < config.opening_time:
            return self._motion.open(np.zeros(ARM_JOINTS))
        speed = config.backing_speed * way / left
        return self._motion.open(self._arm.velocity(view.joints, speed, np.zeros(3), 0.3, self._servo.period))

    def _carry(self) -> Action:
        if self._retreat is None:
            raise ResetNeededError(f"receiver {self.name!r} has nothing to carry")
        view = self._view
        return self._motion.carry(self._retreat.velocity(view.time, view.joints, view.hand))
