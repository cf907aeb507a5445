"""GA-DDPG (Wang et al., CoRL 2021) as HandoverSim evaluates it: a learned policy that sees points alone.

It waits at the start pose, then decides every 0.15 s where the hand goes next, from the object's cloud in the wrist
camera and the number of decisions that are left; when that is 0, or enough points are between the fingers, it closes
them where it is and carries the object to the goal in a straight line. It sees neither the human hand nor true poses.

What decides results and is not what one would expect, each as the original scripts have it:

- It waits at the robot's start pose, not at the pose of the other methods.
- The cloud is the last one seen, thinned more at each decision, with draws of a fixed seed; once the object is out of
  sight the policy runs on memory. Clouds are rounded to float32 in the robot's base frame, poses in between too.
- An object that moved by more than 0.1 m since the last look gives five more decisions, up to 20.
- While nothing was ever seen, the start pose is commanded and no decision is counted.
- One call of inverse kinematics a decision, from where the arm is, whether it gets there or not.
- Whether it is done is looked at on the last millisecond of each decision. More than 50 of 1,024 points between the
  fingers do, repeats counted, at whatever angle, and whatever the hand does.
- A picture is drawn then, too, and thrown away: what Bullet draws enters its broad phase, and without it the last bits
  of the arm's motion are others.
- The points on the way to the goal are 0.03 m apart, the last may lie behind it, and all are solved from the joints at
  the beginning; the hand may turn.
"""

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped_weights import GADDPG_WEIGHTS
from handover_marl.config import ARM_JOINTS
from handover_marl.episode.observations import SIGHT, Observation
from handover_marl.episode.sight import CLOUDS
from handover_marl.errors import OptionError, PolicyError, ResetNeededError
from handover_marl.models.panda import CLOSED, OPEN
from handover_marl.models.poses import quaternion_from_matrix
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.waiting import wait_ms
from handover_marl.receivers.gaddpg_memory import MemoryConfig, PointMemory
from handover_marl.receivers.solvers import StepSolver, step_solver

Array = npt.NDArray[np.float64]

# How files of this library's own weights end.
_OWN = ".npz"

#: From points (4, 1030) float64 and the decisions left to translation (m) and Euler angles (rad), six numbers: the
#: next hand pose in the hand link's frame, turned about x, then y, then z, the axes at rest.
GaddpgFunction = Callable[[Array, int], npt.ArrayLike]


@dataclass(frozen=True)
class GaddpgTiming:
    """When what happens, as HandoverSim sets it.

    Attributes:
        wait_ms: How long to stay at the start pose (ms).
        decision_ms: How long every decision, and every point on the way to the goal, is commanded (ms).
        close_ms: How long the fingers close (ms).
        retreat_step: Distance of points on the way to the goal (m).
    """

    wait_ms: int = 3000
    decision_ms: int = 150
    close_ms: int = 500
    retreat_step: float = 0.03


class GaddpgReceiver(Receiver):
    """Moves by what a network makes of points.

    Made for `robot="panda_camera"`, the Panda with the camera's body. Asked late it decides late, asked more often it
    commands the same. A receiver with a network of your own is a subclass that passes it here, under a name of its own.

    Args:
        context: The robot and the task.
        network: What decides. Either this or `weights`, or the library's own weights where neither is given.
        weights: File or folder of the original authors' checkpoint, or an .npz file that
            `experiments/train_gaddpg.py` wrote, which ends in .npz; needs PyTorch. The library's own go to the grasp
            that they tell, and results say that they are "own weights".
        wait: How long to stay at the start pose (s): 3 is "hold", 0 "w/o hold".
        max_steps: Decisions that an approach may take, as the model was trained: its configuration's RL_MAX_STEP. By
            default what the library's own weights say (30), or else 20.
        memory: Constants of what is remembered.
        timing: When what happens.

    Raises:
        OptionError: PyTorch is not installed, or network and weights are given, or a number is impossible.
        DataNotFoundError, DataFormatError, UnsafeFileError: The weights cannot be read.
    """

    name = "gaddpg"
    control_period = 0.15
    file_options = ("weights",)
    sight = CLOUDS
    observes = SIGHT

    def __init__(
        self,
        context: PolicyContext,
        network: GaddpgFunction | None = None,
        weights: str | None = None,
        wait: float | None = None,
        max_steps: int | None = None,
        memory: MemoryConfig | None = None,
        timing: GaddpgTiming | None = None,
    ) -> None:
        super().__init__(context)
        self._network, self._label, own_steps = _chosen(network, weights)
        self.timing = timing or GaddpgTiming()
        if wait is not None:
            self.timing = replace(self.timing, wait_ms=wait_ms(wait))
        config = memory or MemoryConfig()
        if max_steps is None and memory is None:
            max_steps = own_steps
        if max_steps is not None:
            if isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1:
                raise OptionError(f"max_steps={max_steps!r} must be a whole number, 1 or more")
            config = replace(config, max_steps=max_steps)
        self.memory = PointMemory(config)
        self._start = np.array(context.panda.start_joints)
        self._kinematics: StepSolver | None = None
        self._forget()

    @property
    def label(self) -> str:
        """The name, and which weights."""
        return self._label

    @property
    def wait(self) -> float:
        """How long it stays at the start pose (s)."""
        return self.timing.wait_ms / 1000.0

    @property
    def hold_time(self) -> float:
        """Until the next command differs, or it is to be seen whether the hand is there."""
        return (self._until_ms - self._now_ms) / 1000.0

    def reset(self, seed: int | None = None) -> None:
        """Forget what was seen. What is drawn depends on the method's own seed alone."""
        if self._kinematics is None:
            # Read here rather than at the first decision, where it would count as planning time.
            self._kinematics = step_solver(self.context.panda_urdf, self.context.panda)
        self._forget()

    def _forget(self) -> None:
        self.memory.forget()
        self._decided, self._judged = -1, True
        self._target = self._start
        self._close_ms: int | None = None
        self._retreat: list[Array] = []
        self._now_ms, self._until_ms = 0, math.inf

    def act(self, observation: Observation) -> Action:
        """The next nine target joint positions."""
        timing, self._now_ms = self.timing, round(1000.0 * float(observation["time"][0]))
        into = self._now_ms - timing.wait_ms
        if into < 0:
            return self._command(self._start, OPEN, timing.wait_ms)
        number, last = into // timing.decision_ms, into % timing.decision_ms == timing.decision_ms - 1
        if self._close_ms is None and number > self._decided:
            self._judge(observation)
        if self._close_ms is None and number > self._decided:
            self._target = self._decide(observation)
            self._decided, self._judged = number, False
        if self._close_ms is None and last:
            self._judge(observation)
        if self._close_ms is None or self._now_ms < self._close_ms:
            end = timing.wait_ms + (number + 1) * timing.decision_ms
            return self._command(self._target, OPEN, end if last else end - 1)
        closed = self._close_ms + timing.close_ms
        if self._now_ms < closed:
            return self._command(self._target, CLOSED, closed)
        return self._carry(observation, closed)

    def _command(self, arm: Array, fingers: float, until_ms: float) -> Action:
        self._until_ms = until_ms
        return np.array([*arm[:ARM_JOINTS], fingers, fingers], dtype=np.float32)

    def _judge(self, observation: Observation) -> None:
        """Whether the last decision brought the hand to the object; once a decision, since points are drawn."""
        if self._judged:
            return
        self._judged = True
        if self.memory.remaining == 0 or self.memory.caged(self._base_from_hand(observation)):
            self._close_ms = self.timing.wait_ms + (self._decided + 1) * self.timing.decision_ms

    def _decide(self, observation: Observation) -> Array:
        points = observation["wrist_object_cloud"][: int(observation["wrist_point_counts"][0])]
        pose = self._base_from_hand(observation)
        self.memory.see(points, pose)
        if self.memory.cloud.shape[1] == 0:
            return self._start
        step = np.asarray(self._network(self.memory.network_input(pose), self.memory.remaining), dtype=np.float64)
        if step.shape != (6,):
            raise PolicyError(
                f"the network of {self.name!r} gave an array of shape {step.shape}; six numbers are wanted"
            )
        goal = pose @ _pose_step(step)
        self.memory.remaining -= 1
        target = self._solver().in_world(np.concatenate([goal[:3, 3], quaternion_from_matrix(goal[:3, :3])]))
        return self._solver().step_towards(observation["robot_joint_position_exact"], target[:3], target[3:])

    def _carry(self, observation: Observation, closed_ms: int) -> Action:
        if not self._retreat:
            self._retreat = self._way(observation)
        number = (self._now_ms - closed_ms) // self.timing.decision_ms
        last = len(self._retreat) - 1
        until = closed_ms + (number + 1) * self.timing.decision_ms if number < last else math.inf
        return self._command(self._retreat[min(number, last)], CLOSED, until)

    def _way(self, observation: Observation) -> list[Array]:
        """Arm joints on the straight way to the goal; its points are float32, as the hand's place is."""
        position = observation["gripper_pose"][:3].copy()
        way = np.array(self.context.protocol.goal_center) - position
        length = np.linalg.norm(way)
        step = way / length * self.timing.retreat_step
        joints = []
        for _ in range(math.ceil(length / self.timing.retreat_step)):
            position += step
            joints.append(self._solver().step_towards(observation["robot_joint_position_exact"], position))
        return joints or [self._target]

    def _base_from_hand(self, observation: Observation) -> Array:
        pose = self._solver().in_base(observation["gripper_pose"])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = _rotation(pose[3:]), pose[:3]
        return matrix

    def _solver(self) -> StepSolver:
        if self._kinematics is None:
            raise ResetNeededError(f"receiver {self.name!r} was asked to act before reset()")
        return self._kinematics


def _chosen(network: GaddpgFunction | None, weights: str | None) -> tuple[GaddpgFunction, str, int | None]:
    """What decides, what results are filed under, and how many decisions it wants."""
    if network is not None and weights is not None:
        raise OptionError("receiver 'gaddpg' takes a network or weights, not both")
    if network is not None:
        return network, GaddpgReceiver.name, None
    weights = str(GADDPG_WEIGHTS) if weights is None else weights
    own = weights.endswith(_OWN)
    if importlib.util.find_spec("torch") is None:
        raise OptionError("receiver 'gaddpg' with weights needs PyTorch: pip install 'handover-marl[train]'")
    # Only who has weights needs it.
    from handover_marl.networks.gaddpg_network import GaddpgNetwork
    from handover_marl.networks.gaddpg_weights import read_weights
    from handover_marl.networks.own_weights import read_own_weights

    found, fingerprint = read_own_weights(weights, GaddpgNetwork) if own else read_weights(weights)
    label = f"{GaddpgReceiver.name}@{'own weights ' if own else ''}{fingerprint}"
    return found.decide, label, found.max_steps


def _pose_step(step: Array) -> Array:
    """(4, 4) of translation (m) and Euler angles (rad): about x, then y, then z, the axes at rest."""
    (sa, sb, sc), (ca, cb, cc) = ([function(angle) for angle in step[3:]] for function in (math.sin, math.cos))
    return np.array(
        [
            [cb * cc, sb * (sa * cc) - ca * sc, sb * (ca * cc) + sa * sc, step[0]],
            [cb * sc, sb * (sa * sc) + ca * cc, sb * (ca * sc) - sa * cc, step[1]],
            [-sb, cb * sa, cb * ca, step[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _rotation(quaternion: Array) -> Array:
    """(3, 3) of a quaternion xyzw, which need not be of unit length: that of the engine is so in float32 alone."""
    x, y, z, w = quaternion
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    wx, wy, wz = w * (x * scale), w * (y * scale), w * (z * scale)
    xx, xy, xz = x * (x * scale), x * (y * scale), x * (z * scale)
    yy, yz, zz = y * (y * scale), y * (z * scale), z * (z * scale)
    return np.array(
        [
            [1.0 - (yy + zz), xy - wz, xz + wy],
            [xy + wz, 1.0 - (xx + zz), yz - wx],
            [xz - wy, yz + wx, 1.0 - (xx + yy)],
        ]
    )
