"""Action schemes of givers, which convert network outputs to the givers' actions."""

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, giver_action_space
from handover_marl.geometry.arrays import AnyArray, widen
from handover_marl.geometry.rotations import quaternions_from_rotation_vectors, rotate_points
from handover_marl.givers.array_giver import compute_withdrawals
from handover_marl.givers.reactions import HandoverPoseVariation
from handover_marl.learning.action_scheme import ArrayScheme, RawScheme
from handover_marl.learning.array_features import compute_handover_frames, rotate_to_world
from handover_marl.policies.batch import make_giver_actions
from handover_marl.policies.policy import PolicyContext


class RawGiverScheme(RawScheme):
    """Identity scheme of givers: the outputs are the action Box(8) in physical units."""

    name, agent, size = "giver", "giver", GIVER_ACTION_SIZE


class DeviationScheme(ArrayScheme):
    """Scheme whose 8 outputs in [-1, 1] are multiplied by the upper bounds of `giver_action_space`.

    They are a change of the playback rate, a displacement (m), a rotation vector (rad) and the release. The giver
    follows the recording if all are 0, and releases the object if the last one exceeds 0.5.
    """

    name, agent, size = "deviation", "giver", GIVER_ACTION_SIZE

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the bounds of the actions; the constructor calls this once."""
        space, arrays = giver_action_space(context.config.giver), self._arrays
        self._low, self._high = arrays.asarray(space.low, "float64"), arrays.asarray(space.high, "float64")

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return actions (r, 8) of the episodes with indices `rows`: outputs in physical units, within the bounds."""
        xp = self._arrays.xp
        return xp.astype((self._outputs[rows] * self._high).clip(self._low, self._high), xp.float32)


class HandoverPoseScheme(ArrayScheme):
    """Scheme in which the network decides once per episode: handover pose, and withdrawal after the release.

    Outputs are requested when the recorded hand is about to stop at its own handover pose. Before that time the giver
    follows the recording; afterwards it holds the chosen pose until the object is released, because robots take resting
    objects best. If the gripper does not approach for two seconds, `HandoverPoseVariation` varies the pose.

    | outputs | meaning at 1, in the frame of `compute_handover_frames` |
    |---|---|
    | 0-2 | translation of the object by 0.25 m: towards the gripper, to the left of this direction, and up |
    | 3-5 | rotation of hand and object by 1 rad about these axes through the object's center |
    | 6 | withdrawal of the hand by 0.3 m after the release; at -1 it stays |

    Attributes:
        max_output_translation: Translation of the object at output 1 (m).
        max_output_rotation: Rotation of hand and object at output 1 (rad).
        max_withdrawal: Distance by which the hand withdraws at output 1 (m).
        arrival_tolerance: Largest distance that the recorded wrist may still move along an axis when
            outputs are requested (m).
        latest_decision_s: Episode time at which outputs are requested at the latest (s).
        pose_variation: Variation of the pose if the gripper does not approach.
    """

    name, agent, size = "offer", "giver", 7
    max_output_translation, max_output_rotation, max_withdrawal = 0.25, 1.0, 0.3
    arrival_tolerance = 0.01
    latest_decision_s = 2.5

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the arrays with the decision in each of n = `count` episodes; the constructor calls this once."""
        arrays = self._arrays
        self.pose_variation = HandoverPoseVariation(count, arrays)
        self._has_decided, self._has_pose, self._has_withdrawn = (arrays.zeros(count, "bool") for _ in range(3))
        self._shift, self._turn, self._withdrawal = (arrays.zeros((count, 3)) for _ in range(3))

    def reset(self, row: int) -> None:
        """Clear the decision of the finished episode at index `row`; the giver follows the recording again."""
        super().reset(row)
        self._has_decided[row] = self._has_pose[row] = self._has_withdrawn[row] = False
        self._shift[row] = self._turn[row] = 0.0
        self.pose_variation.reset(row)

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return (r,) whether to decide: once, when the hand with the object stops soon, or at `latest_decision_s`."""
        xp, coming = self._arrays.xp, observation["replay_wrist_poses"][:, 2:, :3]
        moves = xp.astype(xp.max(xp.abs(coming - coming[:, -1:]), axis=(1, 2)), xp.float64)
        is_arriving = moves < self.arrival_tolerance
        is_late = xp.astype(observation["time"][:, 0], xp.float64) >= self.latest_decision_s
        can = (observation["holding"][:, 0] != 0.0) & (observation["hand_present"][:, 0] != 0.0)
        return ~self._has_decided[rows] & can & (is_arriving | is_late)

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Use outputs (r, 7), clipped to [-1, 1], as the decisions of the episodes with indices `rows`."""
        super().set_outputs(rows, outputs)
        self._has_decided[rows] = True

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return actions (r, 8) of the episodes `rows`: zeros, then the chosen pose, then the withdrawal."""
        xp = self._arrays.xp
        new = xp.nonzero(self._has_decided[rows] & ~self._has_pose[rows])[0]
        if len(new):
            self._choose_poses(rows[new], {key: value[new] for key, value in observation.items()})
        has_pose, released = self._has_pose[rows], observation["released"][:, 0] != 0.0
        offers = xp.nonzero(has_pose & ~released)[0]
        if len(offers):
            self.pose_variation.update(rows[offers], {key: value[offers] for key, value in observation.items()})
        scale = self.pose_variation.scale[rows, None]
        displacement, leaves = scale * self._shift[rows], has_pose & released
        if leaves.any():
            self._withdraw(rows, observation, leaves & ~self._has_withdrawn[rows], displacement)
            displacement = xp.where(leaves[:, None], self._withdrawal[rows], displacement)
        rotation = scale * self._turn[rows]
        return make_giver_actions(len(rows), displacement=displacement, rotation=rotation, arrays=self._arrays)

    def _choose_poses(self, rows: AnyArray, observation: Observation) -> None:
        outputs, (center, axes) = self._outputs[rows], compute_handover_frames(observation)
        turn = rotate_to_world(axes, outputs[:, 3:6]) * self.max_output_rotation
        # Actions rotate about the wrist, so the translation compensates the object's motion.
        wrist = widen(observation["replay_wrist_poses"][:, -1, :3])
        rotated = wrist + rotate_points(quaternions_from_rotation_vectors(turn), center - wrist)
        self._shift[rows] = center + rotate_to_world(axes, outputs[:, :3]) * self.max_output_translation - rotated
        self._turn[rows], self._has_pose[rows] = turn, True

    def _withdraw(self, rows: AnyArray, observation: Observation, begins: AnyArray, shift: AnyArray) -> None:
        """Store the final displacements of the hands that begin to withdraw, where `begins` (r,) is True.

        A hand moves from its present displacement `shift` (r, 3) in m away from the gripper, as far as output 6 says.
        """
        length = (self._outputs[rows, 6:] + 1.0) / 2.0 * self.max_withdrawal
        withdrawal = shift + compute_withdrawals(observation, length)
        self._withdrawal[rows[begins]], self._has_withdrawn[rows[begins]] = withdrawal[begins], True
