"""Action schemes of many givers at once; see `handover_marl.learning.giver_schemes` for their meaning."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import giver_action_space
from handover_marl.geometry.poses import compute_lengths, rotate_points
from handover_marl.givers.cooperative_batch import PoseTimerBatch, make_giver_actions
from handover_marl.learning.batch.features import compute_handover_frames, rotate_to_world
from handover_marl.learning.batch.schemes import SchemeBatch
from handover_marl.learning.giver_schemes import DeviationScheme, HandoverPoseScheme
from handover_marl.receivers.grasp_selection import GraspSelectionBatch

Array = npt.NDArray[np.float64]
Actions = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int_]
Flags = npt.NDArray[np.bool_]


class DeviationBatch(SchemeBatch):
    """Batch of `DeviationScheme`."""

    def __init__(self, scheme: DeviationScheme, selection: GraspSelectionBatch, count: int) -> None:
        super().__init__(scheme, selection, count)
        self._space = giver_action_space(scheme.context.config.giver)

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8): the outputs in physical units, within the actions' bounds."""
        space = self._space
        return np.clip(self._outputs[rows] * space.high, space.low, space.high).astype(np.float32)


class HandoverPoseBatch(SchemeBatch):
    """Batch of `HandoverPoseScheme`."""

    def __init__(self, scheme: HandoverPoseScheme, selection: GraspSelectionBatch, count: int) -> None:
        super().__init__(scheme, selection, count)
        self._scheme = scheme
        self._decided, self._chosen, self._withdrawn = (np.zeros(count, dtype=bool) for _ in range(3))
        self._shift, self._turn, self._withdrawal = (np.zeros((count, 3)) for _ in range(3))
        self._timer = PoseTimerBatch(count)

    def reset(self, row: int) -> None:
        """Clear the decision of the previous episode; the giver follows the recording."""
        super().reset(row)
        self._decided[row] = self._chosen[row] = self._withdrawn[row] = False
        self._shift[row] = self._turn[row] = 0.0
        self._timer.reset(row)

    def needs_outputs(self, rows: Rows, observation: Observation) -> Flags:
        """Return whether each recorded hand is about to stop and no outputs were set yet."""
        coming = observation["replay_wrist_poses"][:, 2:, :3]
        moves = np.abs(coming - coming[:, -1:]).max(axis=(1, 2)).astype(np.float64)
        is_arriving = moves < self._scheme.arrival_tolerance
        is_late = observation["time"][:, 0].astype(np.float64) >= self._scheme.latest_decision_s
        can = (observation["holding"][:, 0] != 0.0) & (observation["hand_present"][:, 0] != 0.0)
        return np.asarray(~self._decided[rows] & can & (is_arriving | is_late))

    def set_outputs(self, rows: Rows, outputs: npt.NDArray[np.floating]) -> None:
        """Store the outputs (r, 7) of these episodes, clipped to [-1, 1]."""
        super().set_outputs(rows, outputs)
        self._decided[rows] = True

    def compute_actions(self, rows: Rows, observation: Observation) -> Actions:
        """Return the actions (r, 8): deviation to the chosen poses, or withdrawal after the release."""
        new = np.flatnonzero(self._decided[rows] & ~self._chosen[rows])
        if len(new):
            self._choose_poses(rows[new], {key: value[new] for key, value in observation.items()})
        chosen, released = self._chosen[rows], observation["released"][:, 0] != 0.0
        offers = np.flatnonzero(chosen & ~released)
        if len(offers):
            self._timer.update(rows[offers], {key: value[offers] for key, value in observation.items()})
        share = self._timer.share[rows, None]
        displacement, leaves = share * self._shift[rows], chosen & released
        if leaves.any():
            self._withdraw(rows, observation, leaves & ~self._withdrawn[rows], displacement)
            displacement = np.where(leaves[:, None], self._withdrawal[rows], displacement)
        return make_giver_actions(len(rows), displacement=displacement, rotation=share * self._turn[rows])

    def _choose_poses(self, rows: Rows, observation: Observation) -> None:
        scheme, outputs = self._scheme, self._outputs[rows]
        center, axes = compute_handover_frames(observation)
        turn = rotate_to_world(axes, outputs[:, 3:6]) * scheme.turn
        wrist = observation["replay_wrist_poses"][:, -1, :3].astype(np.float64)
        rotated = wrist + rotate_points(Rotation.from_rotvec(turn).as_quat(), center - wrist)
        # Actions rotate about the wrist, so the translation compensates the object's motion.
        self._shift[rows] = center + rotate_to_world(axes, outputs[:, :3]) * scheme.max_shift - rotated
        self._turn[rows], self._chosen[rows] = turn, True

    def _withdraw(self, rows: Rows, observation: Observation, begins: Flags, shift: Array) -> None:
        """Set the displacement of the hands that begin to withdraw."""
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        size = compute_lengths(away).astype(np.float64)[:, None]
        length = (self._outputs[rows, 6:] + 1.0) / 2.0 * self._scheme.withdraw
        withdrawal = shift + length * away / np.maximum(size, 1e-6)
        self._withdrawal[rows[begins]], self._withdrawn[rows[begins]] = withdrawal[begins], True
