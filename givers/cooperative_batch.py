"""Givers `cooperative` of many episodes at once, on arrays with the episode as first axis."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.geometry.poses import compute_dot_products, compute_lengths, rotate_points
from handover_marl.givers.cooperative import CooperativeGiver, HandoverPoseTimer
from handover_marl.policies.batch import ArrayPolicy

Array = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]
Flags = npt.NDArray[np.bool_]


def make_giver_actions(
    count: int,
    rate: npt.ArrayLike = 0.0,
    displacement: npt.ArrayLike = 0.0,
    rotation: npt.ArrayLike = 0.0,
    release: npt.ArrayLike = 0.0,
) -> Actions:
    """Make actions (r, 8) of r givers of their components; see `policies.policy.make_giver_action`.

    Args:
        count: Number r of givers.
        rate: Playback rates minus 1, (r,) or one for all.
        displacement: Set-points (r, 3) of the wrists' displacements, world frame (m).
        rotation: Set-points (r, 3) of the rotation vectors about the wrists, world frame (rad).
        release: Whether to release the objects, (r,).
    """
    actions = np.zeros((count, GIVER_ACTION_SIZE), dtype=np.float32)
    actions[:, 0], actions[:, 1:4], actions[:, 4:7], actions[:, 7] = rate, displacement, rotation, release
    return actions


def compute_grip_distances(observation: Observation) -> Array:
    """Return the distances (r,) of the grippers from the objects' origins (m)."""
    between = observation["gripper_pose"][:, :3] - observation["object_poses"][:, 0, :3]
    return np.asarray(compute_lengths(between).astype(np.float64))


class PoseTimerBatch:
    """Batch of `HandoverPoseTimer`: changes handover poses that the gripper does not approach.

    Args:
        count: Number of episodes.

    Attributes:
        share: Factor (n,) by which each deviation from the recorded handover pose is multiplied.
    """

    def __init__(self, count: int) -> None:
        self.share = np.full(count, HandoverPoseTimer.shares[0])
        self._timeouts, self._min_distance = np.zeros(count, dtype=np.int_), np.full(count, np.inf)
        self._since = np.full(count, np.nan)

    def reset(self, row: int) -> None:
        """Start an episode."""
        self.share[row], self._timeouts[row] = HandoverPoseTimer.shares[0], 0
        self._min_distance[row], self._since[row] = np.inf, np.nan

    def update(self, rows: Rows, observation: Observation) -> None:
        """Update `share` of the episodes `rows`, whose hands are at their handover poses."""
        now, distance = observation["time"][:, 0].astype(np.float64), compute_grip_distances(observation)
        since, closest = self._since[rows], self._min_distance[rows]
        nearer = np.isnan(since) | (distance < closest - HandoverPoseTimer.min_approach)
        late = ~nearer & (now - since >= HandoverPoseTimer.timeout)
        self._timeouts[rows] += late
        number = self._timeouts[rows] % len(HandoverPoseTimer.shares)
        self.share[rows] = np.where(late, np.array(HandoverPoseTimer.shares)[number], self.share[rows])
        self._since[rows] = np.where(nearer | late, now, since)
        self._min_distance[rows] = np.where(nearer, distance, np.where(late, np.inf, closest))


class CooperativeBatch(ArrayPolicy[CooperativeGiver]):
    """Batch of `CooperativeGiver`."""

    def __init__(self, policy: CooperativeGiver, count: int) -> None:
        super().__init__(policy, count)
        self._displacement, self._rotation, self._withdrawn = (np.zeros((count, 3)) for _ in range(3))
        self._is_fixed, self._is_withdrawn = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._grasped_since, self._timer = np.full(count, np.nan), PoseTimerBatch(count)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation from the recording."""
        self._displacement[row] = self._rotation[row] = 0.0
        self._is_fixed[row] = self._is_withdrawn[row] = False
        self._grasped_since[row] = np.nan
        self._timer.reset(row)

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8): deviations towards the grippers, or withdrawals after a release."""
        released = observation["released"][:, 0] != 0.0
        present = observation["hand_present"][:, 0] != 0.0
        near = compute_grip_distances(observation) < self._policy.near_distance
        chooses = ~released & present & ~self._is_fixed[rows]
        if chooses.any():
            self._choose_poses(rows[chooses], {key: value[chooses] for key, value in observation.items()})
        self._is_fixed[rows] |= ~released & (near | self._has_arrived(observation))
        offers = ~released & self._is_fixed[rows]
        if offers.any():
            self._timer.update(rows[offers], {key: value[offers] for key, value in observation.items()})
        share = self._timer.share[rows, None]
        displacement = share * self._displacement[rows]
        self._withdraw(rows, released & ~self._is_withdrawn[rows], displacement, observation)
        return make_giver_actions(
            len(rows),
            np.where(released, 0.0, self._policy.config.rate),
            displacement=np.where(released[:, None], self._withdrawn[rows], displacement),
            rotation=share * self._rotation[rows],
            release=~released & self._are_grasped(rows, ~released, near, observation),
        )

    def _has_arrived(self, observation: Observation) -> Flags:
        """Return whether each recorded hand has stopped at its handover pose."""
        wrist = observation["replay_wrist_poses"][..., :3]
        moves = np.abs(wrist - wrist[:, :1]).max(axis=(1, 2)).astype(np.float64)
        return np.asarray((observation["holding"][:, 0] != 0.0) & (moves < self._policy.arrival_tolerance))

    def _choose_poses(self, rows: Rows, observation: Observation) -> None:
        """Choose the deviations from the recorded poses half a second ahead."""
        config = self._policy.config
        gripper = observation["gripper_pose"][:, :3].astype(np.float64)
        wrist = observation["replay_wrist_poses"][:, -1, :3].astype(np.float64)
        item = observation["replay_object_poses"][:, -1, :3].astype(np.float64)
        direction = gripper - item
        rotation = self._rotate_towards(item - wrist, direction)
        distance = compute_lengths(direction)
        wanted = np.minimum(config.approach_share * distance, distance - config.min_distance)
        length = np.clip(wanted, 0.0, config.max_displacement)
        target = item + direction / np.maximum(distance, 1e-6)[:, None] * length[:, None]
        # The rotation moves the object about the wrist; the displacement compensates for it.
        moved = rotate_points(Rotation.from_rotvec(rotation).as_quat(), item - wrist)
        self._displacement[rows], self._rotation[rows] = target - moved - wrist, rotation

    def _rotate_towards(self, arms: Array, directions: Array) -> Array:
        """Return the limited rotation vectors (r, 3) that turn directions `arms` towards others."""
        axes = np.cross(arms, directions)
        size = compute_lengths(axes)
        angle = np.minimum(np.arctan2(size, compute_dot_products(arms, directions)), self._policy.config.max_rotation)
        is_turned = size >= 1e-9
        return np.where(is_turned[:, None], axes / np.where(is_turned, size, 1.0)[:, None] * angle[:, None], 0.0)

    def _are_grasped(self, rows: Rows, held: Flags, near: Flags, observation: Observation) -> Flags:
        """Return whether fingers have rested on each object for long enough."""
        now = observation["time"][:, 0].astype(np.float64)
        fingers, speeds = (
            observation[key][:, 7:].astype(np.float64) for key in ("robot_joint_position", "robot_joint_velocity")
        )
        resting = ((np.abs(speeds) < 2e-3) & (fingers > 1e-3) & (fingers < 0.0385)).all(axis=1) & near
        since = self._grasped_since[rows]
        since = np.where(held, np.where(resting, np.where(np.isnan(since), now, since), np.nan), since)
        self._grasped_since[rows] = since
        return np.asarray(resting & (now - since >= self._policy.grasp_time))

    def _withdraw(self, rows: Rows, begins: Flags, shift: Array, observation: Observation) -> None:
        """Set the displacement of the hands that begin to withdraw."""
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        withdrawal = shift + self._policy.config.withdrawal * away / np.maximum(compute_lengths(away), 1e-6)[:, None]
        self._withdrawn[rows[begins]], self._is_withdrawn[rows[begins]] = withdrawal[begins], True
