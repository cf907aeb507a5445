"""Controllers of MuJoCo worlds: actuator targets and mocap poses of the coming steps.

Row k is step k of the current reference motion; row -1 is the state before its first step.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, PhysicsConfig
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.simulation.mujoco.batches.simulation import BatchSimulation, WorldData
from handover_marl.simulation.mujoco.quaternions import XYZW, wxyz_from_euler
from handover_marl.simulation.mujoco.sleep import SleepState
from handover_marl.simulation.reference_tracking import (
    BodyTrajectory,
    ReferenceMotion,
    list_hand_motors,
    select_keypoint_links,
    track_references,
)

Array = npt.NDArray[np.float64]

#: Position of an absent hand, out of everything's reach (m).
ABSENT = (0.0, 0.0, -10.0)


class WorldController:
    """Controller of one MuJoCo world during one episode.

    Args:
        data: Model and state of the world.
        simulation: Simulation of the worlds, with computations that they share.
        hand_urdf: Model of the human hand.
        config: Motors of all bodies, and gravity.
        start: Reference motion of one row: the initial state of hand and objects.

    Attributes:
        data: Model and state of the world.
        robot: Simulation of the robot alone.
        hand: Trajectory of the hand, valid once it has tracked the reference; see `track_worlds`.
        sleep: Sleep state of the world; None once the world is awake.
        reference: Current reference motion.
        row: Last simulated row of the reference motion; -1 before its first step.
        robot_target: Nine joint targets of the robot (rad, m) for which the controls were
            computed; None before the first computation.
        is_tracked: Whether hand and sleeping objects have followed the current reference.
        release_pending: Whether the target object is released in the next step.
        controls: Computed controls (n, c) of n steps from `controls_row` on.
        controls_row: Row of the reference motion at which `controls` starts.
        hand_free_steps: Number of steps from `controls_row` on in which the hand cannot touch the
            robot.
    """

    def __init__(
        self,
        data: WorldData,
        simulation: BatchSimulation,
        hand_urdf: Path,
        config: PhysicsConfig,
        start: ReferenceMotion,
    ) -> None:
        scene = data.scene
        self.data, self.reference, self.row = data, start, -1
        tree = read_tree(hand_urdf)
        self.hand = BodyTrajectory(list_hand_motors(config.hand), start.hand[0] if start.hand_present[0] else None)
        self.robot = simulation.get_robot(scene.robot_only)
        self.sleep: SleepState | None = SleepState(scene, self.robot, config, start)
        self.robot_target: list[float] | None = None
        self.is_tracked, self.release_pending = True, False
        self.controls, self.controls_row, self.hand_free_steps = np.zeros((0, 0)), 0, 0
        self._gravity = config.gravity
        self._hand_kinematics = simulation.get_hand_kinematics(hand_urdf, scene.hand_links.tolist())
        self._keypoint_kinematics = simulation.get_hand_kinematics(hand_urdf, select_keypoint_links(tree.moving_links))
        data.mocap_pos[scene.hand] = ABSENT
        self._is_state_set = False

    @property
    def coming_controls(self) -> Array:
        """Computed controls (n, c) of the n remaining steps of the reference motion."""
        return self.controls[self.row + 1 - self.controls_row :]

    @property
    def remaining_steps(self) -> int:
        """Number of steps until the reference motion ends or the world may wake."""
        left = len(self.reference.objects) - (self.row + 1)
        return left if self.sleep is None else min(left, self.sleep.count_free_steps(self.row + 1))

    def get_hand_joints(self) -> Array | None:
        """Return the current joint positions (51,) of the human hand (m, rad), or None without a hand."""
        track_worlds([self])
        return self.hand.get_joints(self.row) if self.hand.is_present_after(self.row) else None

    def compute_keypoints(self, joints: Array) -> npt.NDArray[np.float32]:
        """Return the world positions (16, 3) of the human hand's wrist and finger joints (m)."""
        positions, _ = self._keypoint_kinematics.compute_poses(joints[None])
        return np.asarray(positions[0], dtype=np.float32)

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the reference motion of hand and objects for the coming steps."""
        # Trajectories continue from the end of the last reference.
        track_worlds([self])
        self.set_state()
        if self.sleep is not None:
            self.sleep.advance_rows(self.row + 1)
        self.row, self.reference, self.robot_target, self.is_tracked = -1, motion, None, False

    def set_row(self, row: int) -> None:
        """Set the last simulated row of the reference motion; row -1 is before the first step."""
        self.row, self._is_state_set = row, self.sleep is None

    def set_state(self) -> None:
        """Write the state of a sleeping world to its data, which is updated only on demand."""
        if self.sleep is not None and not self._is_state_set:
            data, scene = self.data, self.data.scene
            data.qpos[scene.robot_qpos], data.qvel[scene.robot_qvel] = self.sleep.get_robot_state(self.row)
            data.qpos[scene.object_qpos] = self.sleep.compute_object_poses(self.row).ravel()
            self._is_state_set = True

    def wake(self) -> None:
        """Wake the world: robot and objects are simulated together from the coming step on."""
        if self.sleep is not None:
            self.set_state()
            self.data.qvel[self.data.scene.object_qvel] = self.sleep.compute_object_velocities(self.row).ravel()
            self.data.time[:] = self.sleep.compute_time(self.row)
            self.sleep, self.robot_target = None, None

    def wake_if_needed(self, target: list[float]) -> None:
        """Simulate the robot of a sleeping world; wake the world if a body comes near.

        Args:
            target: Nine joint targets of the coming steps (rad, m).
        """
        if self.sleep is not None:
            if self.robot_target != target:
                self.robot_target = target
                self.sleep.simulate_robot(self.row + 1, target, self.hand)
            if not self.sleep.count_free_steps(self.row + 1):
                self.wake()

    def release_pending_object(self) -> None:
        """Release the target object if its release is pending."""
        if self.release_pending:
            self.wake()
            self.data.release_object(self._gravity)
            self.release_pending = False

    def can_touch_hand(self, steps: int) -> bool:
        """Return whether the hand can touch the robot within a number of coming steps."""
        return self.row + 1 - self.controls_row + steps > self.hand_free_steps

    def place_hand(self, free_steps: int, positions: Array, quaternions: Array) -> None:
        """Compute the mocap poses of the hand's bodies in the remaining steps.

        The hand is moved far away in steps in which it cannot collide.

        Args:
            free_steps: Number of coming steps in which the hand cannot touch the robot.
            positions: Array (n, k, 3) to write positions to (m).
            quaternions: Array (n, k, 4) to write quaternions wxyz to.
        """
        positions[:free_steps] = ABSENT
        self.hand_free_steps = free_steps
        if free_steps >= len(positions):
            return
        # The first row is the state before the coming steps.
        joints, present = self.hand.joints[self.row + 2 :], self.hand.present[self.row + 2 :]
        changes = (joints[1:] != joints[:-1]).any(axis=1) | (present[1:] != present[:-1])
        joints, present = joints[1:], present[1:]
        # Steps before the hand appears are free of contact, too.
        coming = np.flatnonzero(present[free_steps:])
        self.hand_free_steps = free_steps + (int(coming[0]) if len(coming) else len(present) - free_steps)
        positions[free_steps:][~present[free_steps:]] = ABSENT
        if not len(coming):
            return
        changes[self.hand_free_steps] = True
        new = np.flatnonzero(present & changes)
        new = new[new >= self.hand_free_steps]
        poses = self._hand_kinematics.compute_poses(joints[new])
        # Each step has the poses of the last change before it.
        steps = free_steps + coming
        source = np.searchsorted(new, steps, side="right") - 1
        positions[steps], quaternions[steps] = poses[0][source], poses[1][source]


def track_worlds(controllers: Sequence[WorldController]) -> None:
    """Compute the trajectories of hands and sleeping objects under new reference motions."""
    behind = [controller for controller in controllers if not controller.is_tracked]
    hands = [(one.hand, one.reference.hand, one.reference.hand_present) for one in behind]
    objects = [
        (item, one.reference.objects[:, number], None)
        for one in behind
        if one.sleep is not None
        for number, item in enumerate(one.sleep.objects)
    ]
    track_references([*hands, *objects])
    for controller in behind:
        controller.is_tracked = True


def prepare_controls(controllers: Sequence[WorldController], robot_targets: Sequence[list[float]]) -> None:
    """Compute the controls of each world's remaining steps after a change of targets or reference.

    Args:
        controllers: Controllers of the worlds.
        robot_targets: Nine joint targets of each robot (rad, m).
    """
    track_worlds(controllers)
    for controller in controllers:
        controller.release_pending_object()
    groups: dict[tuple[int, ...], list[tuple[WorldController, list[float]]]] = {}
    for controller, target in zip(controllers, robot_targets, strict=True):
        controller.wake_if_needed(target)
        if controller.sleep is None and controller.robot_target != target:
            controller.robot_target, controller.controls_row = target, controller.row + 1
            model = controller.data.scene.model
            # Models with equally many objects, actuators and mocap bodies have them in the same places.
            steps, objects = controller.reference.objects.shape[:2]
            key = (steps - controller.controls_row, objects, model.nu, model.nmocap)
            groups.setdefault(key, []).append((controller, target))
    for group in groups.values():
        _compute_controls([controller for controller, _ in group], np.array([target for _, target in group]))


def _compute_controls(controllers: Sequence[WorldController], targets: Array) -> None:
    """Compute the controls of w worlds with equally many actuators, mocap bodies and steps.

    Args:
        controllers: Controllers of the worlds.
        targets: Joint targets (w, 9) of the robots (rad, m).
    """
    first = controllers[0].data
    scene, references = first.scene, first.scene.rotation_references
    objects = np.stack([one.reference.objects[one.controls_row :] for one in controllers])
    # All controls are set below; those of the hand's bodies follow for each world.
    controls = np.empty((*objects.shape[:2], first.ctrl.size + first.mocap_pos.size + first.mocap_quat.size))
    actuators, positions, quaternions = first.split_controls(controls)
    positions[..., references, :] = np.stack([one.data.mocap_pos[references] for one in controllers])[:, None]
    quaternions[:] = np.stack([one.data.mocap_quat for one in controllers])[:, None]
    actuators[..., scene.robot_ctrl] = targets[:, None]
    # Actuators drive objects to world positions; the target orientation is that of a mocap body.
    object_targets = np.zeros(objects.shape)
    object_targets[..., : OBJECT_DOF // 2] = objects[..., : OBJECT_DOF // 2]
    actuators[..., scene.object_ctrl] = object_targets.reshape(*objects.shape[:2], -1)
    quaternions[..., references, :] = wxyz_from_euler(objects[..., OBJECT_DOF // 2 :])
    free_steps = _count_hand_free_steps(controllers, targets).tolist()
    for number, (controller, free) in enumerate(zip(controllers, free_steps, strict=True)):
        controller.controls = controls[number]
        controller.place_hand(free, positions[number][:, scene.hand], quaternions[number][:, scene.hand])


def _count_hand_free_steps(controllers: Sequence[WorldController], targets: Array) -> npt.NDArray[np.int_]:
    """Return the numbers (w,) of coming steps in which each hand cannot touch its robot."""
    worlds, scene = [one.data for one in controllers], controllers[0].data.scene
    joints = np.array([world.qpos[scene.robot_qpos] for world in worlds])
    velocities = np.array([world.qvel[scene.robot_qvel] for world in worlds])
    poses = [
        np.concatenate(one.robot.compute_body_poses(own), axis=1)[scene.robot_only.links]
        for one, own in zip(controllers, joints, strict=True)
    ]
    links = np.array(poses)[..., [0, 1, 2, *(3 + place for place in XYZW)]]
    centers = np.array([one.hand.predict_positions(one.row + 1) for one in controllers])[:, :, None]
    reach = np.array([[world.scene.hand_reach] for world in worlds])
    bounds = scene.robot_only.motion_bounds
    return bounds.count_contact_free_steps((joints, velocities), links, targets, centers, reach)[:, 0]
