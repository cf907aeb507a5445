"""Action schemes of givers, which convert network outputs to the giver's actions."""

from abc import abstractmethod

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, GiverAction, giver_action_space
from handover_marl.givers.cooperative import HandoverPoseVariation
from handover_marl.learning.action_scheme import Action, ActionScheme, Outputs, RawScheme
from handover_marl.learning.features import compute_handover_frame
from handover_marl.policies.policy import make_giver_action


class RawGiverScheme(RawScheme):
    """Identity scheme of givers: the outputs are the action Box(8) in physical units."""

    name, agent, size = "giver", "giver", GIVER_ACTION_SIZE


class GiverScheme(ActionScheme):
    """Base class of invertible giver schemes, with which other givers can be imitated."""

    @abstractmethod
    def outputs_from_action(self, action: Action, observation: Observation) -> Outputs:
        """Return the outputs (size,) in [-1, 1] whose action is nearest to a giver's action (8,)."""


class DeviationScheme(GiverScheme):
    """Deviation from the recorded motion: the giver's action Box(8), scaled to [-1, 1].

    The giver follows the recording if all outputs are 0, and releases the object if the last output
    exceeds 0.5.
    """

    name, agent, size = "deviation", "giver", GIVER_ACTION_SIZE

    def compute_action(self, observation: Observation) -> Action:
        """Return the giver's action (8,): the outputs in physical units, within the action's bounds."""
        space = giver_action_space(self.context.config.giver)
        return np.clip(self.outputs * space.high, space.low, space.high).astype(np.float32)

    def outputs_from_action(self, action: Action, observation: Observation) -> Outputs:
        """Return the outputs (8,) of a giver's action, divided by its bounds."""
        return np.asarray(np.clip(action / giver_action_space(self.context.config.giver).high, -1.0, 1.0))


class HandoverPoseScheme(GiverScheme):
    """Scheme with one decision per episode: handover pose, and withdrawal after the release.

    Outputs are requested when the recorded hand is about to stop at its own handover pose. Before
    that time the giver follows the recording; afterwards it holds the chosen pose until the object
    is released, because robots take resting objects best. If the gripper does not approach for two
    seconds, `HandoverPoseVariation` varies the pose.

    | outputs | meaning at 1, in the frame of `compute_handover_frame` |
    |---|---|
    | 0-2 | translation of the object: 0.25 m towards the gripper, 0.25 m to its left, 0.25 m up |
    | 3-5 | rotation of hand and object by 1 rad about these axes through the object's center |
    | 6 | withdrawal of the hand by 0.3 m after the release; at -1 it stays |

    Attributes:
        max_output_translation: Translation of the object at output 1 (m).
        max_output_rotation: Rotation of hand and object at output 1 (rad).
        max_withdrawal: Distance by which the hand withdraws at output 1 (m).
        arrival_tolerance: Largest distance that the recorded wrist may still move along an axis when
            outputs are requested (m).
        latest_decision_s: Episode time at which outputs are requested at the latest (s).
    """

    name, agent, size = "offer", "giver", 7
    max_output_translation, max_output_rotation, max_withdrawal = 0.25, 1.0, 0.3
    arrival_tolerance = 0.01
    latest_decision_s = 2.5

    def reset(self) -> None:
        """Clear the decision of the previous episode; the giver follows the recording."""
        super().reset()
        self._decided = self._chosen = False
        self._shift, self._turn = np.zeros(3), np.zeros(3)
        self._withdrawal: npt.NDArray[np.float64] | None = None
        self._pose_variation = HandoverPoseVariation(1)

    def needs_outputs(self, observation: Observation) -> bool:
        """Return whether the recorded hand is about to stop and no outputs were set yet."""
        if self._decided or not observation["holding"][0] or not observation["hand_present"][0]:
            return False
        coming = observation["replay_wrist_poses"][2:, :3]
        is_arriving = float(np.abs(coming - coming[-1]).max()) < self.arrival_tolerance
        return is_arriving or float(observation["time"][0]) >= self.latest_decision_s

    def set_outputs(self, outputs: Outputs) -> None:
        """Store the outputs (7,) of this episode, clipped to [-1, 1]."""
        super().set_outputs(outputs)
        self._decided = True

    def compute_action(self, observation: Observation) -> Action:
        """Return the giver's action (8,): deviation from the recorded motion to the chosen pose.

        After the release, the deviation withdraws the hand.
        """
        if self._decided and not self._chosen:
            self._choose_pose(observation)
        if self._chosen and observation["released"][0]:
            return self._withdraw(observation)
        if self._chosen:
            self._pose_variation.update(np.zeros(1, int), {key: value[None] for key, value in observation.items()})
        scale = float(self._pose_variation.scale[0])
        return make_giver_action(displacement=scale * self._shift, rotation=scale * self._turn)

    def outputs_from_action(self, action: Action, observation: Observation) -> Outputs:
        """Return the outputs (7,) that choose the handover pose of a giver's action (8,).

        An action contains no withdrawal, so its output is 0: half of the full withdrawal.
        """
        target = GiverAction.from_array(action)
        center, axes, rotated = self._rotate_about_wrist(target.rotation, observation)
        shift = axes.T @ (rotated + target.displacement - center) / self.max_output_translation
        return np.asarray(np.clip([*shift, *(axes.T @ target.rotation / self.max_output_rotation), 0.0], -1.0, 1.0))

    def _choose_pose(self, observation: Observation) -> None:
        _, axes = compute_handover_frame(observation)
        self._turn = axes @ self.outputs[3:6] * self.max_output_rotation
        center, _, rotated = self._rotate_about_wrist(self._turn, observation)
        # Actions rotate about the wrist, so the translation compensates the object's motion.
        self._shift = center + axes @ self.outputs[:3] * self.max_output_translation - rotated
        self._chosen = True

    def _rotate_about_wrist(
        self, rotation: npt.NDArray[np.floating], observation: Observation
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return origin (3,) and axes (3, 3) of the handover frame, and the origin rotated about the wrist."""
        center, axes = compute_handover_frame(observation)
        wrist = observation["replay_wrist_poses"][-1, :3].astype(np.float64)
        return center, axes, wrist + Rotation.from_rotvec(rotation).apply(center - wrist)

    def _withdraw(self, observation: Observation) -> Action:
        scale = float(self._pose_variation.scale[0])
        if self._withdrawal is None:
            away = observation["hand_keypoints"][0] - observation["gripper_pose"][:3]
            length = (self.outputs[6] + 1.0) / 2.0 * self.max_withdrawal
            shift = scale * self._shift
            self._withdrawal = shift + length * away / max(float(np.linalg.norm(away)), 1e-6)
        return make_giver_action(displacement=self._withdrawal, rotation=scale * self._turn)
