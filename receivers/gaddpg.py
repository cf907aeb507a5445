"""GA-DDPG (Wang et al., CoRL 2021) as in HandoverSim: a learned policy on point clouds.

The receiver waits at the start configuration. Then it decides every 0.15 s on the next pose of the Panda's hand link,
from the object's point cloud in the wrist camera and the number of remaining decisions. When no decision remains or
enough points are between the fingers, the receiver closes the fingers and carries the object to the goal in a straight
line. It uses neither the person's hand nor true poses.

Details of the authors' scripts that determine the results:

- The receiver waits at the robot's start configuration, not at the waiting pose of other methods.
- While the object is out of sight, the policy uses the last point cloud in which the object was visible. Each decision
  keeps fewer points of a new cloud than the decision before; they are drawn at random with a fixed seed. Clouds and
  intermediate poses are rounded to float32 in the robot's base frame.
- If the mean of the cloud has moved by more than 0.1 m since the last cloud, five decisions are added, up to
  `max_steps` (20 in the authors' scripts).
- Before the object is first visible, the start configuration is commanded and no decision is counted.
- Each decision makes one inverse kinematics query from the present joints, converged or not.
- The end of the approach is checked in the last millisecond of each decision. More than 50 of 1,024 points between the
  fingers, repetitions included, end the approach at any pose of the hand link.
- An image is rendered at that time too, and discarded: rendering changes the broad phase of
  Bullet's collision detection, and without it the last bits of the arm's motion differ.
- Waypoints to the goal are 0.03 m apart; the last one may be beyond the goal. IK for all of
  them starts from the joints at the start of the retreat, with free rotation of the hand link.
"""

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import GADDPG_WEIGHTS
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import FULL_POINTCLOUD
from handover_marl.errors import OptionError, PolicyError
from handover_marl.execution.options import require_modules
from handover_marl.geometry.panda import CLOSED, OPEN
from handover_marl.geometry.rotations import quaternions_from_matrices
from handover_marl.planning.ik_solvers import IkStepper, make_ik_stepper
from handover_marl.policies.policy import Action, PolicyContext, require_reset
from handover_marl.receivers.phased_receiver import CLOSE_MS, RETREAT_STEP, PhasedReceiver

Array = npt.NDArray[np.float64]

#: Six points of the gripper (columns) in the hand link's frame (m): the wrist twice, then four points of the fingers.
#: They are the first columns of the network's input.
GRIPPER_POINTS = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.053, -0.053, 0.053, -0.053],
        [0.0, 0.0, 0.075, 0.075, 0.105, 0.105],
    ]
)

# Values of HandoverSim. Number of object points in the network's input; base b of the share b^n of this number that is
# kept of a view's cloud after n decisions.
_N_POINTS, _THINNING = 1024, 0.95
# Motion of the cloud's mean between two views (m) above which decisions are added, and number of added decisions.
_MOTION_THRESHOLD, _EXTRA_STEPS = 0.1, 5
# Corners of the region between the fingers in the hand link's frame (m), exclusive; the approach ends with more than
# this number of points in the region.
_CAGE_LOWER, _CAGE_UPPER, _CAGE_POINTS = (-0.02, -0.05, 0.06), (0.02, 0.05, 0.11), 50

# Suffix of weight files of this library.
_OWN_SUFFIX = ".npz"

#: Function from points (4, 1030) float64 and the number of remaining decisions to six numbers: the translation (m) and
#: Euler angles (rad, static axes x, y, z) to the next pose of the hand link, in its present frame.
GaddpgFunction = Callable[[Array, int], npt.ArrayLike]


class PointCloudMemory:
    """Memory of the object's last point cloud, and of the number of decisions left before the gripper closes.

    GA-DDPG's scripts call the cloud accumulated, but each camera image with points of the object replaces it.
    `max_steps` is the largest number of decisions left; motion of the object adds some. Random points are selected with
    the same `seed` in every episode.

    Attributes:
        cloud: (3, n) float64 points of the object in the robot's base frame (m); n = 0 before its first view.
        remaining: Number of decisions left.
    """

    def __init__(self, max_steps: int = 20, seed: int = 123456) -> None:
        self._max_steps, self._seed = max_steps, seed
        self.reset()

    def reset(self) -> None:
        """Start an episode: remove the cloud, and restart the count of decisions and the random numbers."""
        self.remaining, self.cloud = self._max_steps, np.zeros((3, 0))
        self._mean = np.zeros(3)
        # The scripts seed NumPy's global legacy generator, on whose bits everything depends.
        self._rng = np.random.RandomState(self._seed)

    def update(self, points: npt.NDArray[np.float32], base_from_hand: Array) -> None:
        """Replace the cloud by a random part of the object's points in a view; a view without points changes nothing.

        Points (n, 3) float32 are in the hand link's frame (m); `base_from_hand` (4, 4) is its pose in the base frame.
        If the cloud's mean has moved by more than 0.1 m, up to five decisions are added to `remaining`.
        """
        if len(points) == 0:
            return
        transformed = _transform(base_from_hand, points.T)
        kept = min(int(_THINNING ** (self._max_steps - self.remaining) * _N_POINTS), transformed.shape[1])
        columns = self._rng.choice(transformed.shape[1], kept, replace=False)
        self.cloud = transformed[:, columns].astype(np.float64)
        mean = self.cloud.mean(axis=1)
        if np.linalg.norm(self._mean - mean) > _MOTION_THRESHOLD:
            self.remaining = min(self.remaining + _EXTRA_STEPS, self._max_steps)
        self._mean = mean

    def make_network_input(self, base_from_hand: Array) -> Array:
        """Return the network's input (4, 1030) float64 for a pose (4, 4) of the hand link in the base frame.

        The columns are 6 gripper points and 1024 object points. The first three rows are positions in the hand link's
        frame (m), the last row is 1 for gripper points, else 0.
        """
        hand = _transform(_invert_rounded(base_from_hand), self.cloud)
        points = np.zeros((4, GRIPPER_POINTS.shape[1] + _N_POINTS))
        points[:3] = np.concatenate([GRIPPER_POINTS, self._fill_up(hand)], axis=1)
        points[3, : GRIPPER_POINTS.shape[1]] = 1.0
        return points

    def is_object_caged(self, base_from_hand: Array) -> bool:
        """Return whether over 50 of 1024 points (some repeated) are between the fingers at a hand link pose (4, 4)."""
        if self.cloud.shape[1] == 0:
            return False
        hand = _transform(_invert_rounded(base_from_hand), self.cloud)
        lower, upper = (np.array(corner)[:, None] for corner in (_CAGE_LOWER, _CAGE_UPPER))
        inside = np.logical_and.reduce((hand > lower) & (hand < upper), axis=0, keepdims=True)
        return bool(self._fill_up(inside).sum() > _CAGE_POINTS)

    def _fill_up(self, columns: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return (m, 1024) columns: all of the given columns (m, n), then random repetitions of them."""
        count = columns.shape[1]
        missing = _N_POINTS - count
        if missing == 0:
            return columns
        return np.concatenate([columns, columns[:, self._rng.choice(count, missing)]], axis=1)


class GaddpgReceiver(PhasedReceiver):
    """Receiver whose network decides on the next pose of the hand link from point clouds (GA-DDPG).

    The receiver is intended for `robot="panda_camera"`, the Panda with the camera's body. If `act` is called before the
    next decision is due, it repeats the last action; if it is called later, it decides then. A receiver with another
    network is a subclass that passes its network to this class and has its own name.

    Args:
        context: The robot and the task.
        network: Function that decides on the next hand link pose; must not be given with `weights`.
        weights: File or folder of the original authors' checkpoint, or an .npz file that
            `experiments/training/train_gaddpg.py` wrote; needs PyTorch. Default: the library's own weights, with which
            the hand link moves to the predicted grasp. Result labels of .npz weights contain "own weights".
        wait: Time at the start configuration (s): 3 (default) for the published variant "hold", 0 for "w/o hold".
        max_steps: Number of decisions of an approach to an object at rest, RL_MAX_STEP in the configuration of the
            authors' model. Default: the value in an .npz file (30 in the library's own), otherwise 20.

    Attributes:
        memory: Memory of the object's last point cloud.
    """

    name = "gaddpg"
    file_options = ("weights",)
    obs_mode = FULL_POINTCLOUD
    step_ms = 150

    def __init__(
        self,
        context: PolicyContext,
        network: GaddpgFunction | None = None,
        weights: str | os.PathLike[str] | None = None,
        wait: float | None = None,
        max_steps: int | None = None,
    ) -> None:
        super().__init__(context, wait)
        path = None if weights is None else os.fspath(weights)
        self._network, self._label, own_steps = _load_network(network, path)
        if max_steps is not None and (type(max_steps) is not int or max_steps < 1):
            raise OptionError(f"max_steps must be a whole number of at least 1, got {max_steps!r}")
        max_steps = own_steps if max_steps is None else max_steps
        self.memory = PointCloudMemory() if max_steps is None else PointCloudMemory(max_steps)
        self._start = np.array(context.panda.start_joints)
        self._ik_stepper: IkStepper | None = None
        self._start_approach()

    def _start_approach(self) -> None:
        """Reset the state of the approach, at the start of an episode."""
        self._decided, self._is_checked = -1, True
        self._target = self._start
        self._close_ms: int | None = None

    @property
    def label(self) -> str:
        """Name of the receiver, with a hash of its weights unless a network was passed."""
        return self._label

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; `seed` is ignored, since the method has a fixed seed of its own."""
        if self._ik_stepper is None:
            # Loaded here so that it does not count as planning time.
            self._ik_stepper = make_ik_stepper(self.context.panda_urdf, self.context.panda)
        self.memory.reset()
        self._reset_timing()
        self._start_approach()

    def act(self, observation: Observation) -> Action:
        """Return target joint positions (9,): arm (rad), fingers (m)."""
        self._now_ms = round(1000.0 * float(observation["time"][0]))
        elapsed = self._now_ms - self._wait_ms
        if elapsed < 0:
            return self._command(self._start, OPEN, self._wait_ms)
        number, is_last = elapsed // self.step_ms, elapsed % self.step_ms == self.step_ms - 1
        if self._close_ms is None and number > self._decided:
            self._check_end(observation)
        if self._close_ms is None and number > self._decided:
            self._target = self._decide(observation)
            self._decided, self._is_checked = number, False
        if self._close_ms is None and is_last:
            self._check_end(observation)
        if self._close_ms is None or self._now_ms < self._close_ms:
            end = self._wait_ms + (number + 1) * self.step_ms
            return self._command(self._target, OPEN, end if is_last else end - 1)
        closed_ms = self._close_ms + CLOSE_MS
        if self._now_ms < closed_ms:
            return self._command(self._target, CLOSED, closed_ms)
        return self._carry(observation, closed_ms)

    def _check_end(self, observation: Observation) -> None:
        """Set `_close_ms` if the last decision ends the approach; checked once a decision, since this draws points."""
        if self._is_checked:
            return
        self._is_checked = True
        if self.memory.remaining == 0 or self.memory.is_object_caged(self._base_from_hand(observation)):
            self._close_ms = self._wait_ms + (self._decided + 1) * self.step_ms

    def _decide(self, observation: Observation) -> Array:
        """Update the memory, and return the next target joints (9,) (rad, m); the start joints before any points."""
        points = observation["wrist_object_cloud"][: int(observation["wrist_point_counts"][0])]
        pose = self._base_from_hand(observation)
        self.memory.update(points, pose)
        if self.memory.cloud.shape[1] == 0:
            return self._start
        step = np.asarray(self._network(self.memory.make_network_input(pose), self.memory.remaining), dtype=np.float64)
        if step.shape != (6,):
            raise PolicyError(f"the network of {self.name!r} must return six numbers, got an array of {step.shape}")
        goal = pose @ _matrix_from_step(step)
        self.memory.remaining -= 1
        solver = self._solver
        target = solver.to_world_frame(np.concatenate([goal[:3, 3], quaternions_from_matrices(goal[:3, :3])]))
        return solver.solve_step(observation["robot_joint_position_exact"], target[:3], target[3:])

    def _plan_retreat(self, observation: Observation) -> list[Array]:
        """Return joints (9,) (rad, m) at waypoints on the straight line to the goal; their positions are in float32."""
        position = observation["gripper_pose"][:3].copy()
        offset = np.array(self.context.protocol.goal_center) - position
        length = np.linalg.norm(offset)
        step = offset / length * RETREAT_STEP
        joints = []
        for _ in range(math.ceil(length / RETREAT_STEP)):
            position += step
            joints.append(self._solver.solve_step(observation["robot_joint_position_exact"], position))
        return joints or [self._target]

    @property
    def _solver(self) -> IkStepper:
        stepper: IkStepper = require_reset(self._ik_stepper, self.name)  # type: ignore[assignment]
        return stepper

    def _base_from_hand(self, observation: Observation) -> Array:
        """Return the pose (4, 4) of the hand link in the robot's base frame."""
        pose = self._solver.to_base_frame(observation["gripper_pose"])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = _rotation_matrix(pose[3:]), pose[:3]
        return matrix


def _load_network(network: GaddpgFunction | None, weights: str | None) -> tuple[GaddpgFunction, str, int | None]:
    """Return `network` or the function of the weights, the receiver's label, and the weights' `max_steps` or None."""
    if network is not None and weights is not None:
        raise OptionError("receiver 'gaddpg' takes either a network or weights, not both")
    if network is not None:
        return network, GaddpgReceiver.name, None
    weights = str(GADDPG_WEIGHTS) if weights is None else weights
    is_own = weights.endswith(_OWN_SUFFIX)
    require_modules("receiver 'gaddpg' with weights", "train", "torch")
    # Imported here since PyTorch is optional.
    from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork, read_gaddpg_checkpoint
    from handover_marl.learning.networks.weights import read_network_weights

    loaded, fingerprint = read_network_weights(weights, GaddpgNetwork) if is_own else read_gaddpg_checkpoint(weights)
    label = f"{GaddpgReceiver.name}@{'own weights ' if is_own else ''}{fingerprint}"
    return loaded.predict_step, label, loaded.max_steps


def _matrix_from_step(step: Array) -> Array:
    """Return the transform (4, 4) of a step (6,): translation (m) and Euler angles (rad, static axes x, y, z)."""
    (sa, sb, sc), (ca, cb, cc) = ([function(angle) for angle in step[3:]] for function in (math.sin, math.cos))
    return np.array(
        [
            [cb * cc, sb * (sa * cc) - ca * sc, sb * (ca * cc) + sa * sc, step[0]],
            [cb * sc, sb * (sa * sc) + ca * cc, sb * (ca * sc) - sa * cc, step[1]],
            [-sb, cb * sa, cb * ca, step[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _rotation_matrix(quaternion: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion xyzw, whose length differs from 1 by rounding to float32."""
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


def _transform(a_from_b: npt.NDArray[np.floating], points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return points (3, n) of frame b in frame a, by a transform (4, 4), in the precision of the points.

    Exactly three points stay in double precision, as in the original scripts.
    """
    moved: npt.NDArray[np.floating] = a_from_b[:3, :3].dot(points) + a_from_b[:3, [3]]
    return moved if points.shape[1] == 3 else moved.astype(points.dtype)


def _invert_rounded(a_from_b: Array) -> npt.NDArray[np.float32]:
    """Return the float32 inverse (4, 4) of a rigid transform."""
    inverse = np.eye(4, dtype=np.float32)
    inverse[:3, :3] = a_from_b[:3, :3].T
    inverse[:3, 3] = -a_from_b[:3, :3].T.dot(a_from_b[:3, 3])
    return inverse
