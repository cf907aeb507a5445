"""From what a model's sensors feel to the contacts that rules ask about, of one step and of many."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.array_rules import ContactArrays, in_region
from handover_marl.protocol.contacts import NO_POINTS, Contacts
from handover_marl.sim.mujoco.lanes import Felt


def contacts_of(felt: Felt, released: bool) -> Contacts:
    """The contacts of one step.

    Args:
        felt: What was felt in it.
        released: Whether the human has let go.
    """
    scene = felt.scene
    touches = scene.touch.read(felt.sensors)
    force = float(touches.robot_object_force)
    left, right = NO_POINTS, NO_POINTS
    if force > 0.0:
        forces = scene.touch.finger_forces(felt.sensors)
        left, right = (own[there > 0.0] for own, there in zip(_finger_points(felt), forces, strict=True))
    x, y, z = scene.touch.gripper_place(felt.sensors).tolist()
    return Contacts(
        robot_hand=bool(touches.robot_hand),
        robot_object=force > 0.0,
        finger_points=(left, right),
        object_supported=released and bool(touches.supported),
        object_height=float(felt.joints[scene.object_qpos.start + 2]),
        gripper_position=(x, y, z),
        robot_object_force=force,
    )


def contact_arrays(felt: Felt, config: ProtocolConfig) -> ContactArrays:
    """The contacts of k steps of n worlds.

    Args:
        felt: What was felt, (k, n, ...).
        config: Where fingers grasp.
    """
    scene = felt.scene
    touches = scene.touch.read(felt.sensors)
    touching = touches.robot_object_force > 0.0
    fingers, inside = (np.zeros((*touching.shape, 2), dtype=bool) for _ in range(2))
    if touching.any():
        # Few steps have contacts; only there are places worked out.
        near = Felt(scene, felt.sensors[touching], felt.joints[touching])
        there = scene.touch.finger_forces(near.sensors) > 0.0
        fingers[touching] = there.any(axis=-1)
        inside[touching] = (there & in_region(_finger_points(near), config)).any(axis=-1)
    return ContactArrays(
        robot_hand=touches.robot_hand,
        robot_object=touching,
        fingers=fingers,
        in_region=inside,
        object_supported=touches.supported,
        object_height=felt.joints[..., scene.object_qpos.start + 2],
        gripper_position=scene.touch.gripper_place(felt.sensors),
    )


def _finger_points(felt: Felt) -> npt.NDArray[np.float32]:
    """(..., 2, 8, 3) where the left and the right finger are touched, in their frames (m)."""
    touch = felt.scene.touch
    return touch.finger_points(felt.sensors, *touch.finger_frames(felt.sensors)).astype(np.float32)
