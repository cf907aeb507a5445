"""Givers `cooperative` of many episodes at once, on arrays with the episode as first axis."""

import math
from typing import TypeAlias

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, ArrayFactory, widen
from handover_marl.geometry.poses import compute_dot_products, compute_lengths, rotate_points
from handover_marl.geometry.rotations import quaternions_from_rotation_vectors
from handover_marl.givers.cooperative import CooperativeGiver, HandoverPoseVariation
from handover_marl.policies.batch import (
    Actions,
    ArrayPolicy,
    make_giver_actions,
)

#: Flags (r,).
Flags: TypeAlias = AnyArray


def compute_gripper_object_distances(observation: Observation) -> AnyArray:
    """Return the distances (r,) of the grippers from the objects' origins (m), float64."""
    return widen(compute_lengths(observation["gripper_pose"][:, :3] - observation["object_poses"][:, 0, :3]))


class HandoverPoseVariationBatch:
    """Batch of `HandoverPoseVariation`.

    Args:
        count: Number of episodes.
        arrays: Creator of the arrays.

    Attributes:
        scale: Factor (n,) by which each deviation from the recorded handover pose is multiplied.
    """

    def __init__(self, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._xp, self._scales = arrays.xp, arrays.asarray(HandoverPoseVariation.scales)
        self.scale = arrays.full(count, HandoverPoseVariation.scales[0])
        self._timeouts, self._min_distance = arrays.zeros(count, "int64"), arrays.full(count, math.inf)
        self._since = arrays.full(count, math.nan)

    def reset(self, row: int) -> None:
        """Start an episode."""
        self.scale[row], self._timeouts[row] = HandoverPoseVariation.scales[0], 0
        self._min_distance[row], self._since[row] = math.inf, math.nan

    def update(self, rows: AnyIndices, observation: Observation) -> None:
        """Update `scale` of the episodes `rows`, whose hands are at their handover poses."""
        xp, now, distance = self._xp, widen(observation["time"][:, 0]), compute_gripper_object_distances(observation)
        since, closest = self._since[rows], self._min_distance[rows]
        nearer = xp.isnan(since) | (distance < closest - HandoverPoseVariation.min_approach)
        late = ~nearer & (now - since >= HandoverPoseVariation.timeout)
        self._timeouts[rows] += late
        number = self._timeouts[rows] % len(HandoverPoseVariation.scales)
        self.scale[rows] = xp.where(late, self._scales[number], self.scale[rows])
        self._since[rows] = xp.where(nearer | late, now, since)
        self._min_distance[rows] = xp.where(nearer, distance, xp.where(late, math.inf, closest))


class CooperativeBatch(ArrayPolicy[CooperativeGiver]):
    """Batch of `CooperativeGiver`."""

    def __init__(self, policy: CooperativeGiver, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        super().__init__(policy, count, arrays=arrays)
        self._displacement, self._rotation, self._withdrawn = (arrays.zeros((count, 3)) for _ in range(3))
        self._is_fixed, self._is_withdrawn = (arrays.zeros(count, "bool") for _ in range(2))
        self._pose_variation = HandoverPoseVariationBatch(count, arrays)
        self._grasped_since = arrays.full(count, math.nan)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation from the recording."""
        self._displacement[row] = self._rotation[row] = 0.0
        self._is_fixed[row] = self._is_withdrawn[row] = False
        self._grasped_since[row] = math.nan
        self._pose_variation.reset(row)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8): deviations towards the grippers, or withdrawals after a release."""
        xp = self._arrays.xp
        released = observation["released"][:, 0] != 0.0
        present = observation["hand_present"][:, 0] != 0.0
        near = compute_gripper_object_distances(observation) < self._policy.near_distance
        chooses = xp.nonzero(~released & present & ~self._is_fixed[rows])[0]
        if len(chooses):
            self._choose_poses(rows[chooses], {key: value[chooses] for key, value in observation.items()})
        self._is_fixed[rows] |= ~released & (near | self._has_arrived(observation))
        waiting = xp.nonzero(~released & self._is_fixed[rows])[0]
        if len(waiting):
            self._pose_variation.update(rows[waiting], {key: value[waiting] for key, value in observation.items()})
        scale = self._pose_variation.scale[rows, None]
        displacement = scale * self._displacement[rows]
        self._withdraw(rows, released & ~self._is_withdrawn[rows], displacement, observation)
        return make_giver_actions(
            len(rows),
            xp.where(released, 0.0, self._policy.config.rate),
            displacement=xp.where(released[:, None], self._withdrawn[rows], displacement),
            rotation=scale * self._rotation[rows],
            release=~released & self._are_grasped(rows, ~released, near, observation),
            arrays=self._arrays,
        )

    def _has_arrived(self, observation: Observation) -> Flags:
        """Return whether each recorded hand has stopped at its handover pose."""
        xp, wrist = self._arrays.xp, observation["replay_wrist_poses"][..., :3]
        moves = widen(xp.max(xp.abs(wrist - wrist[:, :1]), axis=(1, 2)))
        return (observation["holding"][:, 0] != 0.0) & (moves < self._policy.arrival_tolerance)

    def _choose_poses(self, rows: AnyIndices, observation: Observation) -> None:
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

    def _are_grasped(self, rows: AnyIndices, held: Flags, near: Flags, observation: Observation) -> Flags:
        """Return whether fingers have rested on each object for long enough."""
        xp, now = self._arrays.xp, widen(observation["time"][:, 0])
        fingers, speeds = (widen(observation[f"robot_joint_{key}"][:, 7:]) for key in ("position", "velocity"))
        resting = xp.all((xp.abs(speeds) < 2e-3) & (fingers > 1e-3) & (fingers < 0.0385), axis=1) & near
        since = self._grasped_since[rows]
        since = xp.where(held, xp.where(resting, xp.where(xp.isnan(since), now, since), math.nan), since)
        self._grasped_since[rows] = since
        return resting & (now - since >= self._policy.grasp_time)

    def _withdraw(self, rows: AnyIndices, begins: Flags, shift: AnyArray, observation: Observation) -> None:
        """Set the displacement of the hands that begin to withdraw."""
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        withdrawal = shift + self._policy.config.withdrawal * away / compute_lengths(away).clip(1e-6)[:, None]
        self._withdrawn[rows] = self._arrays.xp.where(begins[:, None], withdrawal, self._withdrawn[rows])
        self._is_withdrawn[rows] |= begins
