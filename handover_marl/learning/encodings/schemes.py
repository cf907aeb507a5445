"""Built-in action schemes, which convert network outputs to actions of givers and receivers."""

from handover_marl.config import ARM_DOF, PANDA_DOF
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import GIVER_ACTION_SIZE, giver_action_space
from handover_marl.geometry.arm import ArmKinematics, solve_damped
from handover_marl.geometry.arrays import AnyArray, get_namespace, stack_last, to_float64
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import CLOSED, LOWER_LIMITS, OPEN, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.geometry.rotations import (
    compute_rotation_magnitudes,
    conjugate_quaternions,
    multiply_quaternions,
    normalize_quaternions,
    quaternions_from_rotation_vectors,
    rotate_points,
    rotation_vectors_from_quaternions,
)
from handover_marl.geometry.vectors import limit_lengths
from handover_marl.givers.array_giver import compute_withdrawals, is_hand_previewed
from handover_marl.givers.reactions import HandoverPoseVariation
from handover_marl.learning.encodings.action_scheme import ArrayScheme, InvertibleScheme, RawScheme
from handover_marl.learning.encodings.features import compute_handover_frames, rotate_to_frame, rotate_to_world
from handover_marl.policies.batch import make_giver_actions
from handover_marl.policies.policy import PolicyContext


class RawGiverScheme(RawScheme):
    """Identity scheme of givers: the outputs are the action Box(8) in physical units."""

    name, agent, size = "giver", "giver", GIVER_ACTION_SIZE


class DeviationScheme(ArrayScheme):
    """Scheme of deviations from the recording: 8 outputs in [-1, 1], times the upper bounds of `giver_action_space`.

    The products are: playback rate minus 1; displacement (m) and rotation vector (rad) from the recorded to the actual
    wrist, in the world frame; and the release, which happens above 0.5. Zeros follow the recording.
    """

    name, agent, size = "deviation", "giver", GIVER_ACTION_SIZE

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the bounds of the actions; called once, by the constructor."""
        space, arrays = giver_action_space(context.config.giver), self._arrays
        self._low, self._high = arrays.asarray(space.low, "float64"), arrays.asarray(space.high, "float64")

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return actions (r, 8) of the episodes with indices `rows`: outputs in physical units within the bounds."""
        xp = self._arrays.xp
        return xp.astype((self._outputs[rows] * self._high).clip(self._low, self._high), xp.float32)


class HandoverPoseScheme(ArrayScheme):
    """Scheme in which the network makes one decision per episode, an offer: where and how to hold out the object.

    The network is evaluated when the recorded hand is about to stop at its own handover pose. Before that time the
    giver follows the recording. Afterwards it holds the chosen handover pose until the object is released, because
    robots take resting objects best; then it withdraws the hand. If the gripper does not approach for two seconds,
    `HandoverPoseVariation` scales the deviation from the recorded pose.

    | outputs | meaning at 1, in the frame of `compute_handover_frames` |
    |---|---|
    | 0-2 | translation of the object by 0.25 m: towards the gripper, to the left of this direction, and up |
    | 3-5 | rotation vector of hand and object, 1 rad about each of these axes through the object's origin |
    | 6 | withdrawal of the hand from the gripper by 0.3 m after the release; 0.15 m at 0, none at -1 |

    Attributes:
        max_output_translation: Translation of the object at output 1 (m).
        max_output_rotation: Rotation of hand and object at output 1 (rad).
        max_withdrawal: Distance by which the hand withdraws at output 1 (m).
        arrival_tolerance: The hand is about to stop if the recorded wrist positions 0.3 and 0.4 s ahead differ by less
            than this, along each axis, from the position 0.5 s ahead (m).
        latest_decision_s: Episode time from which the network decides even if the recorded wrist still moves (s).
        pose_variation: Variation of the pose if the gripper does not approach.
    """

    name, agent, size = "offer", "giver", 7
    max_output_translation, max_output_rotation, max_withdrawal = 0.25, 1.0, 0.3
    arrival_tolerance = 0.01
    latest_decision_s = 2.5

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the arrays with the decision in each of n = `count` episodes; called once, by the constructor."""
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
        """Return whether the network must decide now, (r,), in the episodes with indices `rows`; it decides once.

        It must when the hand holds the object, and is about to stop or `latest_decision_s` is over.
        """
        xp, coming = self._arrays.xp, observation["replay_wrist_poses"][:, 2:, :3]
        moves = xp.astype(xp.max(xp.abs(coming - coming[:, -1:]), axis=(1, 2)), xp.float64)
        is_arriving = moves < self.arrival_tolerance
        is_late = xp.astype(observation["time"][:, 0], xp.float64) >= self.latest_decision_s
        can = (observation["holding"][:, 0] != 0.0) & is_hand_previewed(observation)
        return ~self._has_decided[rows] & can & (is_arriving | is_late)

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Store outputs (r, 7), clipped to [-1, 1], as the decisions in the episodes with indices `rows`."""
        super().set_outputs(rows, outputs)
        self._has_decided[rows] = True

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return actions (r, 8): zeros (replay) before the decision, then the chosen pose, then the withdrawal."""
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
        wrist = to_float64(observation["replay_wrist_poses"][:, -1, :3])
        rotated = wrist + rotate_points(quaternions_from_rotation_vectors(turn), center - wrist)
        self._shift[rows] = center + rotate_to_world(axes, outputs[:, :3]) * self.max_output_translation - rotated
        self._turn[rows], self._has_pose[rows] = turn, True

    def _withdraw(self, rows: AnyArray, observation: Observation, begins: AnyArray, shift: AnyArray) -> None:
        """Store the final displacements of the hands that begin to withdraw, where `begins` (r,) is True.

        A hand moves from its present displacement `shift` (r, 3) in m away from the gripper, as far as output 6 states.
        """
        length = (self._outputs[rows, 6:] + 1.0) / 2.0 * self.max_withdrawal
        withdrawal = shift + compute_withdrawals(observation, length)
        self._withdrawal[rows[begins]], self._has_withdrawn[rows[begins]] = withdrawal[begins], True


class RawReceiverScheme(RawScheme):
    """Identity scheme of receivers: the outputs are target joint positions (rad, m)."""

    name, agent, size = "receiver", "receiver", PANDA_DOF


class JointScheme(ArrayScheme):
    """Base class of schemes whose actions are target joint positions within the robot's joint limits."""

    agent = "receiver"

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the joint limits; called once, by the constructor."""
        self._low, self._high = self._arrays.asarray(LOWER_LIMITS), self._arrays.asarray(UPPER_LIMITS)

    def _limit_targets(self, arm: AnyArray, closed: AnyArray) -> AnyArray:
        """Return targets (r, 9) within the joint limits for `arm` (r, 7) in rad; grippers close where `closed` (r,)."""
        xp = self._arrays.xp
        clipped = arm.clip(self._low[:ARM_DOF], self._high[:ARM_DOF])
        fingers = xp.where(closed, CLOSED, OPEN)[:, None]
        return xp.astype(xp.concat([clipped, fingers, fingers], axis=1), xp.float32)

    def _encode_fingers(self, actions: AnyArray) -> AnyArray:
        """Return outputs (r, 1) for target positions (r, 9): 1 if they close the gripper, -1 if they open it."""
        is_closed = actions[:, ARM_DOF:].mean(axis=1) < (OPEN + CLOSED) / 2.0
        return self._arrays.xp.where(is_closed, 1.0, -1.0)[:, None]


class JointPositionScheme(JointScheme):
    """Scheme of target joint positions, scaled from [-1, 1] to the joint limits."""

    name, size = "joints", PANDA_DOF

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m) in the episodes with indices `rows`."""
        xp, low = self._arrays.xp, self._low
        return xp.astype(low + (self._outputs[rows] + 1.0) / 2.0 * (self._high - low), xp.float32)


class JointDeltaScheme(JointScheme, InvertibleScheme):
    """Scheme of position increments of the seven arm joints, and an output that moves the gripper.

    The gripper closes while the last output exceeds 0, else it opens.

    Attributes:
        step: Increment of a joint's position at output 1 (rad).
    """

    name, size = "joint_delta", ARM_DOF + 1
    step = 0.2

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m) in the episodes with indices `rows`."""
        outputs = self._outputs[rows]
        arm = observation["robot_joint_position"][:, :ARM_DOF] + self.step * outputs[:, :ARM_DOF]
        return self._limit_targets(arm, outputs[:, ARM_DOF] > 0.0)

    def outputs_from_actions(self, actions: AnyArray, observation: Observation) -> AnyArray:
        """Return outputs (r, 8) for target positions (r, 9); too large increments are scaled down by one factor."""
        xp, arm = self._arrays.xp, observation["robot_joint_position"][:, :ARM_DOF]
        deltas = _limit_largest((to_float64(actions[:, :ARM_DOF]) - arm) / self.step)
        return xp.concat([deltas, self._encode_fingers(actions)], axis=1)


class HandMotionScheme(JointScheme):
    """Base class of schemes that move the Panda's hand link.

    Joint increments follow from the motion by damped least squares on the Jacobian, so that they stay small near
    singular poses and for poses out of reach.

    Attributes:
        damping: Damping factor of the least squares; a larger one limits motions near singular poses more.
    """

    damping = 0.05

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the joint limits and the arm's kinematics; called once, by the constructor."""
        super().allocate(context, count)
        self._robot = ArmKinematics(read_tree(context.panda_urdf))

    def _move(
        self, observation: Observation, translations: AnyArray, rotations: AnyArray, closed: AnyArray
    ) -> AnyArray:
        """Return joint targets (r, 9) that move hand links by translations (r, 3) and rotation vectors (r, 3).

        Both are in the frames of the hand links (m, rad); grippers close where `closed` (r,) is True.
        """
        xp = self._arrays.xp
        arm = xp.astype(observation["robot_joint_position"][:, :ARM_DOF], xp.float64)
        jacobian, _, axes = self._robot.compute_hand_jacobians(arm)
        twist = xp.concat([rotate_to_world(axes, translations), rotate_to_world(axes, rotations)], axis=1)
        return self._limit_targets(arm + solve_damped(jacobian, twist, self.damping), closed)


class CartesianDeltaScheme(HandMotionScheme, InvertibleScheme):
    """Scheme of motions of the Panda's hand link in its own frame, and an output that moves the gripper.

    Outputs are translation (3), rotation vector (3) and gripper, which closes while the last output exceeds 0, else
    opens. The motors complete 63 % of a motion in 0.1 s.

    Attributes:
        max_output_translation: Translation of the hand link at output 1 (m).
        max_output_rotation: Rotation of the hand link at output 1 (rad).
    """

    name, size = "cartesian_delta", 7
    max_output_translation, max_output_rotation = 0.08, 0.3

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m) in the episodes with indices `rows`."""
        outputs = self._outputs[rows]
        translations = outputs[:, :3] * self.max_output_translation
        rotations = outputs[:, 3:6] * self.max_output_rotation
        return self._move(observation, translations, rotations, outputs[:, 6] > 0.0)

    def outputs_from_actions(self, actions: AnyArray, observation: Observation) -> AnyArray:
        """Return outputs (r, 7) for target positions (r, 9), which the Jacobian converts to motions of the hand link.

        Too large translations and rotations are scaled down without a change of direction.
        """
        xp, arm = self._arrays.xp, to_float64(observation["robot_joint_position"][:, :ARM_DOF])
        jacobian, _, axes = self._robot.compute_hand_jacobians(arm)
        twist = xp.sum(jacobian * (to_float64(actions[:, :ARM_DOF]) - arm)[:, None], axis=2)
        translations = rotate_to_frame(axes, twist[:, :3]) / self.max_output_translation
        rotations = rotate_to_frame(axes, twist[:, 3:]) / self.max_output_rotation
        parts = [_limit_largest(translations), _limit_largest(rotations), self._encode_fingers(actions)]
        return xp.concat(parts, axis=1)


class GraspServoScheme(HandMotionScheme):
    """Scheme that moves the gripper to the grasp of lowest cost, with corrections by the outputs, then to the goal.

    The arm stays at the waiting pose for the time `wait`. Then it approaches, along the grasp's z axis, the grasp that
    `LowestCostGraspSelector` chooses: the farther the gripper is from this axis or from the grasp's orientation, the
    longer the standoff, the distance from the grasp along this axis. Without a known grasp the gripper stays where it
    is. After the release it moves to the goal. With zero outputs the gripper never closes, so that the policy has to
    learn when to close and how to correct the approach. In the table, the target is the pose that the gripper
    approaches: the standoff pose, the grasp, or, after the release, the goal with the present orientation.

    | outputs | meaning at 1, in the frame of the target |
    |---|---|
    | 0-2 | translation of the target by 0.01, 0.01 and 0.03 m |
    | 3-5 | rotation of the target by 0.1 rad about each axis |
    | 6 | above 0.5 the gripper closes until the end of the episode |

    Attributes:
        max_output_translation: Translation of the target at output 1, along each axis (m).
        max_output_rotation: Rotation of the target at output 1 (rad).
        close_threshold: Output above which the gripper closes.
        max_translation: Largest distance of the commanded from the present gripper position (m).
        max_rotation: Largest angle between commanded and present gripper orientation (rad).
        lateral_tolerance: Distance of the gripper from the grasp's z axis up to which no standoff is needed (m).
        angle_tolerance: Angle to the grasp's orientation up to which no standoff is needed (rad).
        standoff_per_offset: Increase of the standoff per distance beyond `lateral_tolerance` (m/m).
        standoff_per_angle: Increase of the standoff per angle beyond `angle_tolerance` (m/rad).
        max_standoff: Largest distance of the standoff pose from the grasp (m).
    """

    name, size = "grasp_servo", 7
    wait = 2.0
    max_output_translation, max_output_rotation = (0.01, 0.01, 0.03), 0.1
    close_threshold = 0.5
    max_translation, max_rotation = 0.1, 0.4
    lateral_tolerance, angle_tolerance = 0.01, 0.15
    standoff_per_offset, standoff_per_angle, max_standoff = 3.0, 0.3, 0.15

    def allocate(self, context: PolicyContext, count: int) -> None:
        """Create the goal position, the waiting joints, and the grippers' states in n = `count` episodes."""
        super().allocate(context, count)
        arrays = self._arrays
        self._max_translation = arrays.asarray(self.max_output_translation)
        self._goal = arrays.asarray(context.protocol.goal_center)
        self._waiting_joints = arrays.asarray(WAITING_JOINTS, "float32")
        self._is_closed = arrays.zeros(count, "bool")

    def reset(self, row: int) -> None:
        """Clear the state of the finished episode at index `row`: the gripper is open and the arm waits."""
        super().reset(row)
        self._is_closed[row] = False

    def set_outputs(self, rows: AnyArray, outputs: AnyArray) -> None:
        """Use outputs (r, 7), clipped to [-1, 1], in the episodes with indices `rows` until their next call.

        A gripper whose output 6 exceeds `close_threshold` closes until the end of the episode.
        """
        super().set_outputs(rows, outputs)
        self._is_closed[rows] |= self._outputs[rows, 6] > self.close_threshold

    def needs_outputs(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return whether the time `wait` is over, (r,), in each of the r episodes with indices `rows`."""
        xp = self._arrays.xp
        # Times are float32 and may be rounded down, by less than half a step.
        return xp.astype(observation["time"][:, 0], xp.float64) >= self.wait - 5e-4

    def compute_actions(self, rows: AnyArray, observation: Observation) -> AnyArray:
        """Return the target positions (r, 9) of arms and fingers (rad, m) in the episodes with indices `rows`."""
        xp = self._arrays.xp
        actions = xp.tile(self._waiting_joints, (len(rows), 1))
        acts = xp.nonzero(self.needs_outputs(rows, observation))[0]
        if len(acts):
            actions[acts] = self._servo_to_grasp(rows[acts], {key: value[acts] for key, value in observation.items()})
        return actions

    def _servo_to_grasp(self, rows: AnyArray, observation: Observation) -> AnyArray:
        xp, outputs = self._arrays.xp, self._outputs[rows]
        gripper = xp.astype(observation["gripper_pose"], xp.float64)
        present = normalize_quaternions(gripper[:, 3:])
        position, target = self._find_targets(rows, observation, gripper, present)
        position = position + rotate_points(target, outputs[:, :3] * self._max_translation)
        target = multiply_quaternions(
            target, quaternions_from_rotation_vectors(outputs[:, 3:6] * self.max_output_rotation)
        )
        inverse = conjugate_quaternions(present)
        translation = limit_lengths(rotate_points(inverse, position - gripper[:, :3]), self.max_translation)
        rotation = rotation_vectors_from_quaternions(multiply_quaternions(inverse, target))
        return self._move(observation, translation, limit_lengths(rotation, self.max_rotation), self._is_closed[rows])

    def _find_targets(
        self, rows: AnyArray, observation: Observation, gripper: AnyArray, present: AnyArray
    ) -> tuple[AnyArray, AnyArray]:
        """Return world positions (r, 3) in m and quaternions xyzw (r, 4) of the targets, before outputs correct them.

        Hand links have the world poses `gripper` (r, 7), whose normalized quaternions are `present` (r, 4).
        """
        xp, (grasps, _, exists) = self._arrays.xp, self._selector.select(rows, observation)
        orientation = normalize_quaternions(xp.where(exists[:, None], grasps[:, 3:], present))
        standoff = self._compute_standoffs(gripper[:, :3] - grasps[:, :3], present, orientation)
        zeros = xp.zeros_like(standoff)
        position = grasps[:, :3] - rotate_points(orientation, stack_last([zeros, zeros, standoff]))
        released = observation["released"] != 0.0
        position = xp.where(exists[:, None], position, gripper[:, :3])
        return xp.where(released, self._goal, position), xp.where(released, present, orientation)

    def _compute_standoffs(self, offsets: AnyArray, present: AnyArray, target: AnyArray) -> AnyArray:
        """Return standoffs (r,) in m for hand links at `offsets` (r, 3) from grasps, in m in the world frame.

        `present` (r, 4) are the world quaternions xyzw of the hand links, `target` (r, 4) those of the grasps.
        """
        xp = self._arrays.xp
        local = rotate_points(conjugate_quaternions(target), offsets)
        angle = compute_rotation_magnitudes(multiply_quaternions(conjugate_quaternions(present), target))
        lateral = xp.hypot(local[:, 0], local[:, 1])
        standoff = self.standoff_per_offset * (lateral - self.lateral_tolerance).clip(0.0)
        standoff = standoff + self.standoff_per_angle * (angle - self.angle_tolerance).clip(0.0)
        return standoff.clip(None, self.max_standoff)


def _limit_largest(vectors: AnyArray) -> AnyArray:
    """Scale vectors (r, k) down so that no element exceeds 1 in absolute value; the directions remain."""
    xp = get_namespace(vectors)
    return vectors / xp.max(xp.abs(vectors), axis=1, keepdims=True).clip(1.0)
