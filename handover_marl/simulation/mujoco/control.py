"""Controls of MuJoCo worlds: actuator targets and mocap poses of the coming steps."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF
from handover_marl.simulation.mujoco.batch_simulation import HandKinematics, WorldData
from handover_marl.simulation.mujoco.engine import XYZW, wxyz_from_euler
from handover_marl.simulation.mujoco.sleep import RobotOnlySimulation
from handover_marl.simulation.reference_tracking import BodyTrajectory

Array = npt.NDArray[np.float64]

#: Position of an absent hand, out of everything's reach (m).
ABSENT = (0.0, 0.0, -10.0)


def compute_controls(worlds: Sequence[WorldData], targets: Array, objects: npt.NDArray[np.float32]) -> Array:
    """Compute the controls (w, n, c) of w worlds in n steps, apart from the human hands.

    Controls are actuator targets, then mocap positions (m) and mocap quaternions wxyz. The positions of the hands'
    bodies are undefined until `place_hand` writes them.

    Args:
        worlds: States of the worlds, which have equally many objects, actuators and mocap bodies.
        targets: Joint targets (w, 9) of the robots (rad, m).
        objects: Joint targets (w, n, m, 6) of the objects (m, rad).
    """
    first = worlds[0]
    scene, references = first.scene, first.scene.rotation_references
    controls = np.empty((*objects.shape[:2], first.ctrl.size + first.mocap_pos.size + first.mocap_quat.size))
    actuators, positions, quaternions = first.split_controls(controls)
    positions[..., references, :] = np.stack([one.mocap_pos[references] for one in worlds])[:, None]
    quaternions[:] = np.stack([one.mocap_quat for one in worlds])[:, None]
    actuators[..., scene.robot_ctrl] = targets[:, None]
    # Actuators drive objects to world positions; the target orientation is that of a mocap body.
    object_targets = np.zeros(objects.shape)
    object_targets[..., : OBJECT_DOF // 2] = objects[..., : OBJECT_DOF // 2]
    actuators[..., scene.object_ctrl] = object_targets.reshape(*objects.shape[:2], -1)
    quaternions[..., references, :] = wxyz_from_euler(objects[..., OBJECT_DOF // 2 :])
    return controls


def count_hand_free_steps(
    worlds: Sequence[WorldData], robots: Sequence[RobotOnlySimulation], targets: Array, wrists: Array
) -> npt.NDArray[np.int_]:
    """Return the number (w,) of next steps in which the human hand of each of w worlds cannot touch the robot.

    Args:
        worlds: States of the worlds.
        robots: Simulations of the robots without hand and objects.
        targets: Joint targets (w, 9) of the robots (rad, m).
        wrists: World positions (w, n, 3) of the wrists after each of n coming steps (m); inf without a hand.
    """
    scene = worlds[0].scene
    joints = np.array([one.qpos[scene.robot_qpos] for one in worlds])
    velocities = np.array([one.qvel[scene.robot_qvel] for one in worlds])
    poses = [
        np.concatenate(robot.compute_body_poses(own), axis=1)[scene.robot_only.links]
        for robot, own in zip(robots, joints, strict=True)
    ]
    links = np.array(poses)[..., [0, 1, 2, *(3 + place for place in XYZW)]]
    reach = np.array([[one.scene.hand_reach] for one in worlds])
    bounds = scene.robot_only.motion_bounds
    return bounds.count_contact_free_steps((joints, velocities), links, targets, wrists[:, :, None], reach)[:, 0]


def place_hand(
    hand: BodyTrajectory, row: int, kinematics: HandKinematics, free_steps: int, positions: Array, quaternions: Array
) -> int:
    """Write the world poses of the human hand's k bodies in the n steps after `row` to `positions` and `quaternions`.

    In steps in which the hand is absent or cannot touch the robot, the positions are `ABSENT`, far away.

    Args:
        hand: Trajectory of the hand.
        row: Last simulated step of the reference motion, -1 for none; n steps are left.
        kinematics: Kinematics of the hand's bodies.
        free_steps: Number of coming steps in which the hand cannot touch the robot.
        positions: Array (n, k, 3) to write positions to (m).
        quaternions: Array (n, k, 4) to write quaternions wxyz to.

    Returns:
        Number of steps, at least `free_steps`, before the first one in which the hand may touch the robot.
    """
    positions[:free_steps] = ABSENT
    if free_steps >= len(positions):
        return free_steps
    joints, present = hand.joints[row + 3 :], hand.present[row + 3 :]
    # Steps before the hand appears are free of contact, too.
    steps = free_steps + np.flatnonzero(present[free_steps:])
    positions[free_steps:][~present[free_steps:]] = ABSENT
    positions[steps], quaternions[steps] = kinematics.compute_poses(joints[steps])
    return int(steps[0]) if len(steps) else len(present)
