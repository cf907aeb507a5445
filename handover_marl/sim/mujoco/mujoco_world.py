"""The world simulated by MuJoCo: the same bodies, motors and masks in another engine, several times as fast."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, CameraConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import OptionError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.protocol.contacts import Contacts
from handover_marl.sim.bullet.picture_world import Pictures
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.hand_path import HandPath, keypoint_links
from handover_marl.sim.motion import Motion
from handover_marl.sim.mujoco.chain import XYZW, bullet_quaternion, chain_joints, quaternions_wxyz
from handover_marl.sim.mujoco.felt_contacts import contact_arrays, contacts_of
from handover_marl.sim.mujoco.hand_frames import HandFrames
from handover_marl.sim.mujoco.lanes import Lane, Lanes, roll
from handover_marl.sim.mujoco.scene_model import scene_model
from handover_marl.sim.world import Postures, Rolled, RollingWorld, Snapshot, WorldState

Array = npt.NDArray[np.float64]

# Where a hand is that is not there (m).
_NOWHERE = (0.0, 0.0, -10.0)


class MujocoWorld(RollingWorld):
    """Robot and objects are simulated. The hand follows its targets by kinematics, as in fast physics.

    Args:
        config: Constants of the world.
        window: Must be False: the window is PyBullet's.
        lanes: Beside which others it is simulated; default: alone.

    Raises:
        OptionError: A window was asked for.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False, lanes: Lanes | None = None) -> None:
        if window:
            raise OptionError('physics="mujoco" opens no window; use render_mode="rgb_array", or physics="fast"')
        self._config = config
        self._lanes = lanes or Lanes(1, config.gravity)
        self._lane = Lane()
        self._scene: Scene | None = None
        self._release_pending = False
        self._pictures = Pictures(config)

    def reset(self, scene: Scene, start: Motion) -> None:
        """Put everything at a scene's start."""
        self._lanes.enter(self._lane, scene_model(scene.assets, self._config))
        self._scene = scene
        lane, built = self._lane, self._lane.scene
        servos, places, _ = lane.controls()
        lane.qpos[built.robot_qpos] = servos[built.robot_ctrl] = self._config.panda.start_joints
        free = np.concatenate([start.objects[0, :, :3], quaternions_wxyz(start.objects[0, :, 3:])], axis=1)
        lane.qpos[built.object_qpos] = free.ravel()
        places[built.hand] = _NOWHERE
        tree = read_tree(scene.assets.hand)
        self._hand = HandPath(tree, self._config.hand, start)
        self._hand_frames = HandFrames(scene.assets.hand, built.hand_links)
        moving = [link for link, joint in enumerate(tree.joints) if joint.kind != "fixed"]
        self._keypoint_frames = HandFrames(scene.assets.hand, np.array(keypoint_links(moving)))
        self._chains = start.objects[0].astype(np.float64)
        self._release_pending = False
        self._row = -1
        self._robot_target: list[float] | None = None

    def lead(self, motion: Motion) -> None:
        """Say where objects and hand are led in the coming steps, one row a step."""
        self._row, self._motion, self._robot_target = -1, motion, None
        self._hand.lead(motion)

    def step(self, robot_target: list[float]) -> None:
        """Simulate one step."""
        parts = self._lane.controls()
        for part, given in zip(parts, self._split(self._begin(robot_target)[0]), strict=True):
            part[:] = given
        self._lane.step()
        self._row += 1

    @classmethod
    def roll(
        cls, worlds: Sequence["MujocoWorld"], robot_targets: Sequence[list[float]], steps: int, rules: ProtocolConfig
    ) -> Rolled:
        """As `RollingWorld.roll`."""
        controls = [world._begin(target)[:steps] for world, target in zip(worlds, robot_targets, strict=True)]
        rolled = roll([world._lane for world in worlds], controls)
        for world in worlds:
            world._row += steps

        def cut(number: int, taken: int) -> None:
            rolled.cut(number, taken)
            worlds[number]._row += taken - steps

        return Rolled(contact_arrays(rolled.felt, rules), cut)

    @property
    def companion(self) -> tuple[object, int]:
        """As `RollingWorld.companion`."""
        return self._lane.running, self._lane.row

    def _begin(self, robot_target: list[float]) -> Array:
        """(n, c) what leads the model in the motion's remaining steps."""
        if self._release_pending:
            self._lanes.free_target(self._lane)
            self._release_pending = False
        if robot_target != self._robot_target:
            self._robot_target, self._led_from = robot_target, self._row + 1
            self._controls = self._led(robot_target)
        return self._controls[self._row + 1 - self._led_from :]

    def _led(self, robot_target: list[float]) -> Array:
        scene, motion, first = self._lane.scene, self._motion, self._row + 1
        steps, objects = len(motion) - first, motion.objects[first:]
        controls = np.empty((steps, sum(part.size for part in self._lane.controls())))
        servos, places, turns = self._split(controls)
        present = self._lane.controls()
        places[:], turns[:] = present[1], present[2]
        servos[:, scene.robot_ctrl] = robot_target
        # A servo's target for each step: places in the world; how objects are turned is the guides' to say.
        led = np.zeros((steps, objects.shape[1], OBJECT_DOF))
        led[..., : OBJECT_DOF // 2] = objects[..., : OBJECT_DOF // 2]
        servos[:, scene.object_ctrl] = led.reshape(steps, -1)
        if (objects == objects[0]).all():
            turns[:, scene.guides] = quaternions_wxyz(objects[0, :, OBJECT_DOF // 2 :])
        else:
            turns[:, scene.guides] = quaternions_wxyz(objects[..., OBJECT_DOF // 2 :])
        self._place_hand(robot_target, places[:, scene.hand], turns[:, scene.hand])
        return controls

    def _split(self, controls: Array) -> tuple[Array, Array, Array]:
        """Views of servos' targets (..., u), bodies' places (..., m, 3) and quaternions (..., m, 4) wxyz."""
        servos, places, _ = self._lane.controls()
        u, m = len(servos), len(places)
        shape = controls.shape[:-1]
        return (
            controls[..., :u],
            controls[..., u : u + 3 * m].reshape(*shape, m, 3),
            controls[..., u + 3 * m :].reshape(*shape, m, 4),
        )

    def _place_hand(self, robot_target: list[float], places: Array, turns: Array) -> None:
        """Put the hand's bodies where they are after each remaining step; nowhere while it is surely out of reach."""
        hand, first = self._hand, self._row + 1
        clear = self._clear_steps(robot_target)
        places[:clear] = _NOWHERE
        changes = hand.changes()[first:]
        for number in range(clear, len(places)):
            if not hand.present_after(first + number):
                places[number] = _NOWHERE
            elif number > clear and not changes[number]:
                places[number], turns[number] = places[number - 1], turns[number - 1]
            else:
                places[number], turns[number] = self._hand_frames.poses(hand.joints(first + number))

    def _clear_steps(self, robot_target: list[float]) -> int:
        """For how many of the remaining steps the hand is surely out of reach, so that it need not be there."""
        lane, scene = self._lane, self._lane.scene
        joints = lane.qpos[scene.robot_qpos], lane.qvel[scene.robot_qvel]
        places, turns = lane.frames()
        links = np.concatenate([places[scene.robot_links], turns[scene.robot_links][:, XYZW]], axis=1)
        centers = self._hand.centers(self._row + 1)[:, None]
        reach = np.array([scene.hand_reach])
        return int(scene.robot_clearance.clear_steps(joints, links, robot_target, centers, reach)[0])

    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""
        self._release_pending = True

    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""
        return contacts_of(self._lane.felt(), released)

    def state(self) -> WorldState:
        """The present state of everything."""
        lane, scene, hand, row = self._lane, self._lane.scene, self._hand, self._row
        places, turns = lane.frames()
        # The gripper's pose and behind it the objects'.
        poses = np.concatenate([places[scene.gripper], turns[scene.gripper], lane.qpos[scene.object_qpos]]).reshape(
            -1, 7
        )
        poses[:, 3:] = bullet_quaternion(poses[:, 3:])
        present = hand.present_after(row)
        return WorldState(
            robot_joint_position=lane.qpos[scene.robot_qpos].astype(np.float32),
            robot_joint_velocity=lane.qvel[scene.robot_qvel].astype(np.float32),
            gripper_pose=poses[0].astype(np.float32),
            object_poses=poses[1:].astype(np.float32),
            hand_dof_position=hand.dof(row) if present else None,
            hand_keypoints=self._keypoint_frames.poses(hand.joints(row))[0].astype(np.float32) if present else None,
        )

    def postures(self) -> Postures:
        """The present joints of robot and hand."""
        hand, row = self._hand, self._row
        robot = self.exact_joints().astype(np.float32)
        return Postures(robot, hand.dof(row) if hand.present_after(row) else None)

    def exact_joints(self) -> npt.NDArray[np.float64]:
        """The robot's joints (9,) in double precision (m, rad)."""
        joints: Array = self._lane.qpos[self._lane.scene.robot_qpos].copy()
        return joints

    def object_dof(self) -> npt.NDArray[np.float32]:
        """(n, 6) joint positions that the objects' chains would have (m, rad), float32."""
        free = self._lane.qpos[self._lane.scene.object_qpos].reshape(-1, 7)
        self._chains = chain_joints(free, self._chains)
        chains: npt.NDArray[np.float32] = self._chains.astype(np.float32)
        return chains

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3) of the present state, drawn as in the other kinds of physics."""
        return self._pictures.of(self._scene).draw(self.snapshot(), camera)

    def photograph(self, color: bool, at: Snapshot | None = None) -> Photo:
        """What the wrist camera shows, drawn likewise."""
        return self._pictures.of(self._scene).photograph(at or self.snapshot(), color)

    def close(self) -> None:
        """Free the simulation."""
        self._pictures.close()
        self._lanes.leave(self._lane)
        self._scene = None
