"""Givers `cooperative` of many episodes at once, on arrays with the episode as first axis."""

import math
from typing import TypeAlias

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory, widen
from handover_marl.geometry.poses import compute_dot_products, compute_lengths, rotate_points
from handover_marl.geometry.rotations import quaternions_from_rotation_vectors
from handover_marl.givers.cooperative import CooperativeGiver, HandoverPoseTimer
from handover_marl.policies.batch import Actions, ArrayPolicy, Rows

#: Flags (r,).
Flags: TypeAlias = AnyArray


def make_giver_actions(
    count: int,
    rate: float | AnyArray = 0.0,
    displacement: float | AnyArray = 0.0,
    rotation: float | AnyArray = 0.0,
    release: float | AnyArray = 0.0,
    arrays: ArrayFactory = NUMPY_ARRAYS,
) -> Actions:
    """Make actions (r, 8) of r givers of their components; see `policies.policy.make_giver_action`.

    Args:
        count: Number r of givers.
        rate: Playback rates minus 1, (r,) or one for all.
        displacement: Set-points (r, 3) of the wrists' displacements, world frame (m).
        rotation: Set-points (r, 3) of the rotation vectors about the wrists, world frame (rad).
        release: Whether to release the objects, (r,).
        arrays: Creator of the array.
    """
    actions = arrays.zeros((count, GIVER_ACTION_SIZE), "float32")
    actions[:, 0], actions[:, 1:4], actions[:, 4:7], actions[:, 7] = rate, displacement, rotation, release
    return actions


def compute_grip_distances(observation: Observation) -> AnyArray:
    """Return the distances (r,) of the grippers from the objects' origins (m), float64."""
    return widen(compute_lengths(observation["gripper_pose"][:, :3] - observation["object_poses"][:, 0, :3]))


class PoseTimerBatch:
    """Batch of `HandoverPoseTimer`: changes handover poses that the gripper does not approach.

    Args:
        count: Number of episodes.
        arrays: Creator of the arrays.

    Attributes:
        share: Factor (n,) by which each deviation from the recorded handover pose is multiplied.
    """

    def __init__(self, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._xp, self._shares = arrays.xp, arrays.asarray(HandoverPoseTimer.shares)
        self.share = arrays.full(count, HandoverPoseTimer.shares[0])
        self._timeouts, self._min_distance = arrays.zeros(count, "int64"), arrays.full(count, math.inf)
        self._since = arrays.full(count, math.nan)

    def reset(self, row: int) -> None:
        """Start an episode."""
        self.share[row], self._timeouts[row] = HandoverPoseTimer.shares[0], 0
        self._min_distance[row], self._since[row] = math.inf, math.nan

    def update(self, rows: Rows, observation: Observation) -> None:
        """Update `share` of the episodes `rows`, whose hands are at their handover poses."""
        xp, now, distance = self._xp, widen(observation["time"][:, 0]), compute_grip_distances(observation)
        since, closest = self._since[rows], self._min_distance[rows]
        nearer = xp.isnan(since) | (distance < closest - HandoverPoseTimer.min_approach)
        late = ~nearer & (now - since >= HandoverPoseTimer.timeout)
        self._timeouts[rows] += late
        number = self._timeouts[rows] % len(HandoverPoseTimer.shares)
        self.share[rows] = xp.where(late, self._shares[number], self.share[rows])
        self._since[rows] = xp.where(nearer | late, now, since)
        self._min_distance[rows] = xp.where(nearer, distance, xp.where(late, math.inf, closest))


class CooperativeBatch(ArrayPolicy[CooperativeGiver]):
    """Batch of `CooperativeGiver`."""

    def __init__(self, policy: CooperativeGiver, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        super().__init__(policy, count, arrays=arrays)
        self._displacement, self._rotation, self._withdrawn = (arrays.zeros((count, 3)) for _ in range(3))
        self._is_fixed, self._is_withdrawn = (arrays.zeros(count, "bool") for _ in range(2))
        self._grasped_since, self._timer = arrays.full(count, math.nan), PoseTimerBatch(count, arrays)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation from the recording."""
        self._displacement[row] = self._rotation[row] = 0.0
        self._is_fixed[row] = self._is_withdrawn[row] = False
        self._grasped_since[row] = math.nan
        self._timer.reset(row)

    def decide(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8): deviations towards the grippers, or withdrawals after a release."""
        xp = self._arrays.xp
        released = observation["released"][:, 0] != 0.0
        present = observation["hand_present"][:, 0] != 0.0
        near = compute_grip_distances(observation) < self._policy.near_distance
        chooses = xp.nonzero(~released & present & ~self._is_fixed[rows])[0]
        if len(chooses):
            self._choose_poses(rows[chooses], {key: value[chooses] for key, value in observation.items()})
        self._is_fixed[rows] |= ~released & (near | self._has_arrived(observation))
        offers = xp.nonzero(~released & self._is_fixed[rows])[0]
        if len(offers):
            self._timer.update(rows[offers], {key: value[offers] for key, value in observation.items()})
        share = self._timer.share[rows, None]
        displacement = share * self._displacement[rows]
        self._withdraw(rows, released & ~self._is_withdrawn[rows], displacement, observation)
        return make_giver_actions(
            len(rows),
            xp.where(released, 0.0, self._policy.config.rate),
            displacement=xp.where(released[:, None], self._withdrawn[rows], displacement),
            rotation=share * self._rotation[rows],
            release=~released & self._are_grasped(rows, ~released, near, observation),
            arrays=self._arrays,
        )

    def _has_arrived(self, observation: Observation) -> Flags:
        """Return whether each recorded hand has stopped at its handover pose."""
        xp, wrist = self._arrays.xp, observation["replay_wrist_poses"][..., :3]
        moves = widen(xp.max(xp.abs(wrist - wrist[:, :1]), axis=(1, 2)))
        return (observation["holding"][:, 0] != 0.0) & (moves < self._policy.arrival_tolerance)

    def _choose_poses(self, rows: Rows, observation: Observation) -> None:
        """Choose the deviations from the recorded poses half a second ahead."""
        xp, config = self._arrays.xp, self._policy.config
        gripper = widen(observation["gripper_pose"][:, :3])
        wrist = widen(observation["replay_wrist_poses"][:, -1, :3])
        item = widen(observation["replay_object_poses"][:, -1, :3])
        direction = gripper - item
        rotation = self._rotate_towards(item - wrist, direction)
        distance = compute_lengths(direction)
        wanted = xp.minimum(config.approach_share * distance, distance - config.min_distance)
        length = wanted.clip(0.0, config.max_displacement)
        target = item + direction / distance.clip(1e-6)[:, None] * length[:, None]
        # The rotation moves the object about the wrist; the displacement compensates for it.
        moved = rotate_points(quaternions_from_rotation_vectors(rotation), item - wrist)
        self._displacement[rows], self._rotation[rows] = target - moved - wrist, rotation

    def _rotate_towards(self, arms: AnyArray, directions: AnyArray) -> AnyArray:
        """Return the limited rotation vectors (r, 3) that turn directions `arms` towards others."""
        xp = self._arrays.xp
        axes = xp.linalg.cross(arms, directions)
        size = compute_lengths(axes)
        angle = xp.atan2(size, compute_dot_products(arms, directions)).clip(max=self._policy.config.max_rotation)
        is_turned = size >= 1e-9
        return xp.where(is_turned[:, None], axes / xp.where(is_turned, size, 1.0)[:, None] * angle[:, None], 0.0)

    def _are_grasped(self, rows: Rows, held: Flags, near: Flags, observation: Observation) -> Flags:
        """Return whether fingers have rested on each object for long enough."""
        xp, now = self._arrays.xp, widen(observation["time"][:, 0])
        fingers, speeds = (widen(observation[f"robot_joint_{key}"][:, 7:]) for key in ("position", "velocity"))
        resting = xp.all((xp.abs(speeds) < 2e-3) & (fingers > 1e-3) & (fingers < 0.0385), axis=1) & near
        since = self._grasped_since[rows]
        since = xp.where(held, xp.where(resting, xp.where(xp.isnan(since), now, since), math.nan), since)
        self._grasped_since[rows] = since
        return resting & (now - since >= self._policy.grasp_time)

    def _withdraw(self, rows: Rows, begins: Flags, shift: AnyArray, observation: Observation) -> None:
        """Set the displacement of the hands that begin to withdraw."""
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        withdrawal = shift + self._policy.config.withdrawal * away / compute_lengths(away).clip(1e-6)[:, None]
        self._withdrawn[rows] = self._arrays.xp.where(begins[:, None], withdrawal, self._withdrawn[rows])
        self._is_withdrawn[rows] |= begins
