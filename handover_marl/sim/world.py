"""The world: table, Panda, objects and hand, moved one physics step at a time. Mechanics only, no rules."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pybullet_data

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.errors import SimulationError
from handover_marl.motion import MotionTarget
from handover_marl.protocol.contacts import Contacts
from handover_marl.scene import Scene
from handover_marl.sim.body import Body
from handover_marl.sim.camera import render, without_drawing
from handover_marl.sim.client import BulletClient, connect, float32_list, load_urdf, pybullet_error
from handover_marl.sim.contacts import ContactReader
from handover_marl.sim.hand import Hand
from handover_marl.sim.objects import Object
from handover_marl.sim.panda import Panda

TABLE_MASK = 1


@dataclass(frozen=True)
class WorldState:
    """What can be seen of the world after a step; all float32, world frame, m and rad, quaternions xyzw.

    Attributes:
        robot_joint_position: (9,) arm and finger joints.
        robot_joint_velocity: (9,).
        gripper_pose: (7,) pose of the Panda's hand link.
        object_poses: (n, 7) poses of the objects, the target first.
        hand_dof_position: (51,) or None without a hand.
        hand_keypoints: (16, 3) wrist and finger-joint origins, or None without a hand.
    """

    robot_joint_position: npt.NDArray[np.float32]
    robot_joint_velocity: npt.NDArray[np.float32]
    gripper_pose: npt.NDArray[np.float32]
    object_poses: npt.NDArray[np.float32]
    hand_dof_position: npt.NDArray[np.float32] | None
    hand_keypoints: npt.NDArray[np.float32] | None


class World:
    """HandoverSim's physics to the bit: the same float32 targets give the same states.

    Args:
        config: Constants of the world.
        window: Whether to show PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        self._config = config
        self._client: BulletClient = connect(window)
        self._scene: Scene | None = None
        self._hand: Hand | None = None
        self._release_pending = False

    def reset(self, scene: Scene, start: MotionTarget) -> None:
        """Rebuild the world for a scene, everything at its start.

        Bullet is deterministic for equal call sequences only, so all is loaded anew and in a fixed order.
        """
        self._scene = scene
        try:
            with without_drawing(self._client):
                self._rebuild(scene, start)
        except pybullet_error as error:
            raise self._lost(error) from error

    def _rebuild(self, scene: Scene, start: MotionTarget) -> None:
        client, config = self._client, self._config
        client.resetSimulation()
        client.setGravity(0.0, 0.0, config.gravity)
        client.setPhysicsEngineParameter(
            fixedTimeStep=config.time_step, numSubSteps=1, deterministicOverlappingPairs=1
        )
        load_urdf(client, f"{pybullet_data.getDataPath()}/plane_implicit.urdf")
        table_id = load_urdf(
            client, scene.assets.table, basePosition=float32_list(config.table_position), useFixedBase=True
        )
        Body(client, table_id, ()).collide(TABLE_MASK)
        self._panda = Panda(client, scene.assets.panda, config.panda)
        self._objects = [
            Object(client, urdf, class_id, dof, config.objects)
            for urdf, class_id, dof in zip(scene.assets.objects, scene.info.object_ids, start.objects, strict=True)
        ]
        self._hand = None
        self._place_hand(start.hand)
        self._release_pending = False
        self._contacts = ContactReader(client, table_id, self._panda, self._objects)

    def step(self, robot_target: list[float], motion: MotionTarget) -> None:
        """Simulate one step (1 ms).

        Args:
            robot_target: Nine joint targets for the Panda (rad, m), float32 values.
            motion: Where the objects and the hand are led.
        """
        self._place_hand(motion.hand)
        if self._release_pending:
            self._objects[0].release()
            self._release_pending = False
        self._panda.drive(robot_target)
        for body, target in zip(self._objects, motion.objects, strict=True):
            body.drive(target)
        if self._hand is not None and motion.hand is not None:
            self._hand.drive(motion.hand)
        try:
            self._client.stepSimulation()
        except pybullet_error as error:
            raise self._lost(error) from error

    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""
        self._release_pending = True

    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""
        return self._contacts.read(self._hand, released)

    def state(self) -> WorldState:
        """The present state of everything."""
        position, velocity = self._panda.joint_states()
        object_poses = [body.link_poses([body.link_id])[0] for body in self._objects]
        hand = self._hand
        return WorldState(
            robot_joint_position=position,
            robot_joint_velocity=velocity,
            gripper_pose=self._panda.link_poses([self._panda.hand_link])[0],
            object_poses=np.stack(object_poses),
            hand_dof_position=None if hand is None else hand.joint_states()[0],
            hand_keypoints=None if hand is None else hand.keypoints(),
        )

    def object_dof(self) -> npt.NDArray[np.float32]:
        """(n, 6) joint positions of the objects' chains (m, rad), float32."""
        return np.stack([body.joint_states()[0] for body in self._objects])

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3) of the present state."""
        return render(self._client, camera)

    @staticmethod
    def _lost(error: Exception) -> SimulationError:
        return SimulationError(
            f"PyBullet stopped ({error}); if its window was closed, close() this environment and reset() it again"
        )

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._client.close()

    def _place_hand(self, target: list[float] | None) -> None:
        if target is None and self._hand is not None:
            self._hand.remove()
            self._hand = None
        elif target is not None and self._hand is None and self._scene is not None:
            self._hand = Hand(self._client, self._scene.assets.hand, target, self._config.hand)
