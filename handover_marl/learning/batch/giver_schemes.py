"""Action schemes of many givers at once; see `handover_marl.learning.giver_schemes` for their meaning."""

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import giver_action_space
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, ArrayFactory
from handover_marl.geometry.poses import compute_lengths, rotate_points
from handover_marl.geometry.rotations import quaternions_from_rotation_vectors
from handover_marl.givers.cooperative import HandoverPoseVariation
from handover_marl.learning.batch.features import compute_handover_frames, rotate_to_world
from handover_marl.learning.batch.grasp_selector import LowestCostGraspSelectorBatch
from handover_marl.learning.batch.schemes import SchemeBatch
from handover_marl.learning.giver_schemes import DeviationScheme, HandoverPoseScheme
from handover_marl.policies.batch import make_giver_actions


class DeviationBatch(SchemeBatch):
    """Batch of `DeviationScheme`."""

    def __init__(
        self,
        scheme: DeviationScheme,
        selector: LowestCostGraspSelectorBatch,
        count: int,
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        super().__init__(scheme, selector, count, arrays)
        space = giver_action_space(scheme.context.config.giver)
        self._low, self._high = arrays.asarray(space.low, "float64"), arrays.asarray(space.high, "float64")

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the actions (r, 8): the outputs in physical units, within the actions' bounds."""
        xp = self._arrays.xp
        return xp.astype((self._outputs[rows] * self._high).clip(self._low, self._high), xp.float32)


class HandoverPoseBatch(SchemeBatch):
    """Batch of `HandoverPoseScheme`."""

    def __init__(
        self,
        scheme: HandoverPoseScheme,
        selector: LowestCostGraspSelectorBatch,
        count: int,
        arrays: ArrayFactory = NUMPY_ARRAYS,
    ) -> None:
        super().__init__(scheme, selector, count, arrays)
        self._scheme, self._pose_variation = scheme, HandoverPoseVariation(count, arrays)
        self._decided, self._chosen, self._withdrawn = (arrays.zeros(count, "bool") for _ in range(3))
        self._shift, self._turn, self._withdrawal = (arrays.zeros((count, 3)) for _ in range(3))

    def reset(self, row: int) -> None:
        """Clear the decision of the previous episode; the giver follows the recording."""
        super().reset(row)
        self._decided[row] = self._chosen[row] = self._withdrawn[row] = False
        self._shift[row] = self._turn[row] = 0.0
        self._pose_variation.reset(row)

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether each recorded hand is about to stop and no outputs were set yet."""
        xp, coming = self._arrays.xp, observation["replay_wrist_poses"][:, 2:, :3]
        moves = xp.astype(xp.max(xp.abs(coming - coming[:, -1:]), axis=(1, 2)), xp.float64)
        is_arriving = moves < self._scheme.arrival_tolerance
        is_late = xp.astype(observation["time"][:, 0], xp.float64) >= self._scheme.latest_decision_s
        can = (observation["holding"][:, 0] != 0.0) & (observation["hand_present"][:, 0] != 0.0)
        return ~self._decided[rows] & can & (is_arriving | is_late)

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store the outputs (r, 7) of these episodes, clipped to [-1, 1]."""
        super().set_outputs(rows, outputs)
        self._decided[rows] = True

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the actions (r, 8): deviation to the chosen poses, or withdrawal after the release."""
        xp = self._arrays.xp
        new = xp.nonzero(self._decided[rows] & ~self._chosen[rows])[0]
        if len(new):
            self._choose_poses(rows[new], {key: value[new] for key, value in observation.items()})
        chosen, released = self._chosen[rows], observation["released"][:, 0] != 0.0
        offers = xp.nonzero(chosen & ~released)[0]
        if len(offers):
            self._pose_variation.update(rows[offers], {key: value[offers] for key, value in observation.items()})
        scale = self._pose_variation.scale[rows, None]
        displacement, leaves = scale * self._shift[rows], chosen & released
        if leaves.any():
            self._withdraw(rows, observation, leaves & ~self._withdrawn[rows], displacement)
            displacement = xp.where(leaves[:, None], self._withdrawal[rows], displacement)
        rotation = scale * self._turn[rows]
        return make_giver_actions(len(rows), displacement=displacement, rotation=rotation, arrays=self._arrays)

    def _choose_poses(self, rows: AnyArray, observation: Observation) -> None:
        xp, scheme, outputs = self._arrays.xp, self._scheme, self._outputs[rows]
        center, axes = compute_handover_frames(observation)
        turn = rotate_to_world(axes, outputs[:, 3:6]) * scheme.max_output_rotation
        wrist = xp.astype(observation["replay_wrist_poses"][:, -1, :3], xp.float64)
        rotated = wrist + rotate_points(quaternions_from_rotation_vectors(turn), center - wrist)
        # Actions rotate about the wrist, so the translation compensates the object's motion.
        self._shift[rows] = center + rotate_to_world(axes, outputs[:, :3]) * scheme.max_output_translation - rotated
        self._turn[rows], self._chosen[rows] = turn, True

    def _withdraw(self, rows: AnyArray, observation: Observation, begins: AnyArray, shift: AnyArray) -> None:
        """Set the displacement of the hands that begin to withdraw."""
        xp, away = self._arrays.xp, observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        size = xp.astype(compute_lengths(away), xp.float64)[:, None]
        length = (self._outputs[rows, 6:] + 1.0) / 2.0 * self._scheme.max_withdrawal
        withdrawal = shift + length * away / size.clip(1e-6)
        self._withdrawal[rows[begins]], self._withdrawn[rows[begins]] = withdrawal[begins], True
