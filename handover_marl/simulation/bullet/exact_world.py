"""PyBullet world whose states are bit-equal to HandoverSim."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.simulation.bullet.bodies import (
    HandBody,
    ObjectBody,
    compute_object_masks,
    load_workcell,
)
from handover_marl.simulation.bullet.rendering import render_wrist_camera
from handover_marl.simulation.bullet.world import BulletWorld
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import Contacts


class ExactWorld(BulletWorld):
    """PyBullet world with the same states as HandoverSim, bit for bit, for equal float32 targets.

    All bodies of a scene are simulated, and all are loaded again at every reset.

    Args:
        config: Constants of the world.
        window: Whether to open PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        super().__init__(config, window)
        self._objects: list[ObjectBody] = []
        self._hand: HandBody | None = None
        self._reference: Iterator[tuple[list[list[float]], list[float] | None]] = iter(())

    def reset(self, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene, and set robot, objects and hand to their start positions; see `World.reset`."""
        with self._start_scene(scene):
            panda = replace(self._config.panda, start_joints=tuple(robot_joints))
            self._workcell = load_workcell(self._client, scene.assets, replace(self._config, panda=panda))
            states, masks = start.objects[0].tolist(), compute_object_masks(scene.info.object_ids)
            self._objects = [
                ObjectBody(self._client, urdf, mask, self._config.objects, state)
                for urdf, mask, state in zip(scene.assets.objects, masks, states, strict=True)
            ]
            self._hand = None
            self._update_hand(start.list_hand_targets()[0])

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of hand and objects for the coming physics steps; row k of `motion` is for step k."""
        self._reference = iter(zip(motion.objects.tolist(), motion.list_hand_targets(), strict=True))

    def step(self, robot_target: list[float]) -> None:
        """Simulate one physics step towards nine joint targets of the Panda (rad, m)."""
        object_targets, hand_target = next(self._reference)
        self._update_hand(hand_target)
        if self._release_pending:
            self._objects[0].release()
            self._release_pending = False
        self._loaded_workcell.panda.set_motor_targets(robot_target)
        for body, target in zip(self._objects, object_targets, strict=True):
            body.set_motor_targets(target)
        if self._hand is not None and hand_target is not None:
            self._hand.set_motor_targets(hand_target)
        self._simulate()

    def read_contacts(self, released: bool) -> Contacts:
        """Return the contacts of the last step.

        Contacts of the target object with table and other objects are read only after its release (`released`).
        """
        hand = () if self._hand is None else (self._hand.id,)
        return self._read_contacts(hand, self._objects[0], {body.id for body in self._objects[1:]}, released)

    def read_object_joints(self) -> npt.NDArray[np.float32]:
        """Return the joint positions (n, 6) of n objects: xyz (m), intrinsic XYZ Euler angles (rad), float32."""
        return np.stack([body.read_joint_positions() for body in self._objects])

    def render_wrist_camera(self, snapshot: JointSnapshot | None, color: bool) -> CameraImage:
        """Render an image of the wrist camera for a snapshot, None for the current state; `color` adds colours."""
        if snapshot is not None:
            return super().render_wrist_camera(snapshot, color)
        return render_wrist_camera(self._client, self._loaded_workcell, self._objects, self._hand, color)

    def _update_hand(self, target: list[float] | None) -> None:
        """Load the human hand at its first target, and remove it when there is no target."""
        if target is None and self._hand is not None:
            self._hand.remove()
            self._hand = None
        elif target is not None and self._hand is None and self._scene is not None:
            self._hand = HandBody(self._client, self._scene.assets.hand, target, self._config.hand)

    def _read_object_poses(self) -> npt.NDArray[np.float32]:
        return np.stack([body.read_pose() for body in self._objects])

    def _read_hand_joints(self) -> npt.NDArray[np.float32] | None:
        return None if self._hand is None else self._hand.read_joint_positions()

    def _read_hand_keypoints(self) -> npt.NDArray[np.float32] | None:
        return None if self._hand is None else self._hand.read_keypoints()
