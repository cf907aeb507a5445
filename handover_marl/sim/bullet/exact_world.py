"""HandoverSim's world to the bit: every body simulated, everything loaded anew at a reset."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.protocol.contacts import Contacts
from handover_marl.sim.bullet.body import Start
from handover_marl.sim.bullet.bullet_world import BulletWorld, lost
from handover_marl.sim.bullet.client import pybullet_error
from handover_marl.sim.bullet.contact_reader import ContactReader
from handover_marl.sim.bullet.drawing import without_drawing
from handover_marl.sim.bullet.hand_body import Hand
from handover_marl.sim.bullet.object_body import Object
from handover_marl.sim.bullet.stage import set_stage
from handover_marl.sim.bullet.wrist_view import photograph, seen_bodies
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.motion import Motion
from handover_marl.sim.world import Postures, Snapshot, WorldState


class ExactWorld(BulletWorld):
    """The same float32 targets give the same states as in HandoverSim.

    Args:
        config: Constants of the world.
        window: Whether to show PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        super().__init__(config, window)
        self._hand: Hand | None = None
        self._release_pending = False

    def reset(self, scene: Scene, start: Motion) -> None:
        """Rebuild the world for a scene, everything at its start."""
        self._scene = scene
        try:
            with without_drawing(self._client):
                self._rebuild(scene, start)
        except pybullet_error as error:
            raise lost(error) from error

    def _rebuild(self, scene: Scene, start: Motion) -> None:
        stage = set_stage(self._client, scene.assets, self._config)
        self._panda = stage.panda
        self._objects = [
            Object(self._client, urdf, class_id, Start(dof), self._config.objects)
            for urdf, class_id, dof in zip(
                scene.assets.objects, scene.info.object_ids, start.objects[0].tolist(), strict=True
            )
        ]
        self._hand = None
        self._place_hand(start.hand_targets()[0])
        self._release_pending = False
        self._table_id = stage.table_id
        self._supports = {stage.table_id, *(body.id for body in self._objects[1:])}
        self._reader = ContactReader(self._client, self._panda)

    def lead(self, motion: Motion) -> None:
        """Say where objects and hand are led in the coming steps, one row a step."""
        self._coming = iter(zip(motion.objects.tolist(), motion.hand_targets(), strict=True))

    def step(self, robot_target: list[float]) -> None:
        """Simulate one step."""
        object_targets, hand_target = next(self._coming)
        self._place_hand(hand_target)
        if self._release_pending:
            self._objects[0].release()
            self._release_pending = False
        self._panda.drive(robot_target)
        for body, target in zip(self._objects, object_targets, strict=True):
            body.drive(target)
        if self._hand is not None and hand_target is not None:
            self._hand.drive(hand_target)
        self._simulate()

    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""
        self._release_pending = True

    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""
        hand = () if self._hand is None else (self._hand.id,)
        return self._reader.read(hand, self._objects[0], self._supports if released else ())

    def state(self) -> WorldState:
        """The present state of everything."""
        position, velocity = self._panda.joint_states()
        hand = self._hand
        return WorldState(
            robot_joint_position=position,
            robot_joint_velocity=velocity,
            gripper_pose=self._panda.link_poses([self._panda.hand_link])[0],
            object_poses=np.stack([body.pose() for body in self._objects]),
            hand_dof_position=None if hand is None else hand.joint_positions(),
            hand_keypoints=None if hand is None else hand.keypoints(),
        )

    def postures(self) -> Postures:
        """The present joints of robot and hand."""
        hand = self._hand
        return Postures(self._panda.joint_positions(), None if hand is None else hand.joint_positions())

    def exact_joints(self) -> npt.NDArray[np.float64]:
        """The robot's joints (9,) in double precision (m, rad)."""
        return self._panda.exact_joints()

    def object_dof(self) -> npt.NDArray[np.float32]:
        """(n, 6) joint positions of the objects' chains (m, rad), float32."""
        return np.stack([body.joint_positions() for body in self._objects])

    def photograph(self, color: bool, at: Snapshot | None = None) -> Photo:
        """What the wrist camera shows."""
        if at is not None:
            return self._picture_world().photograph(at, color)
        objects = [body.id for body in self._objects]
        bodies = seen_bodies(self._table_id, self._panda.id, objects, None if self._hand is None else self._hand.id)
        return photograph(self._client, self._panda, bodies, color)

    def _place_hand(self, target: list[float] | None) -> None:
        if target is None and self._hand is not None:
            self._hand.remove()
            self._hand = None
        elif target is not None and self._hand is None and self._scene is not None:
            self._hand = Hand(self._client, self._scene.assets.hand, target, self._config.hand)
