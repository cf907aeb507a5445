"""The world simulated by MuJoCo: the same bodies, motors and masks in another engine, several times as fast."""

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, CameraConfig, PhysicsConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.protocol.contacts import NO_POINTS, Contacts, Points
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.hand_path import HandPath, keypoint_links
from handover_marl.sim.motion import Motion
from handover_marl.sim.mujoco.chain import XYZW, bullet_quaternion, chain_joints, quaternions_wxyz
from handover_marl.sim.mujoco.hand_frames import HandFrames
from handover_marl.sim.mujoco.scene_model import scene_model
from handover_marl.sim.mujoco.simulation import Simulation
from handover_marl.sim.scene_pictures import Pictures
from handover_marl.sim.world import Postures, Snapshot, World, WorldState

_NOTHING = Contacts()
# Once only so few steps are surely clear, looking ahead again and again costs more than having the hand there.
_WORTH = 5
# Where a hand is that is not there (m).
_NOWHERE = (0.0, 0.0, -10.0)


class MujocoWorld(World):
    """Robot and objects are simulated. The hand follows its targets by kinematics, as in fast physics.

    Args:
        config: Constants of the world.
        window: Must be False: the window is PyBullet's.

    Raises:
        OptionError: A window was asked for.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        if window:
            raise OptionError('physics="mujoco" opens no window; use render_mode="rgb_array", or physics="fast"')
        self._config = config
        self._scene: Scene | None = None
        self._sim: Simulation | None = None
        self._pictures = Pictures(config)

    def reset(self, scene: Scene, start: Motion) -> None:
        """Put everything at a scene's start."""
        built = scene_model(scene.assets, self._config)
        if self._sim is None or self._sim.scene is not built:
            self._sim = Simulation(built, self._config.gravity)
        self._sim.reset()
        self._scene = scene
        data = self._sim.data
        data.qpos[built.robot_qpos] = data.ctrl[built.robot_ctrl] = self._config.panda.start_joints
        free = np.concatenate([start.objects[0, :, :3], quaternions_wxyz(start.objects[0, :, 3:])], axis=1)
        data.qpos[built.object_qpos] = free.ravel()
        data.mocap_pos[built.hand] = _NOWHERE
        mujoco.mj_kinematics(self._sim.model, data)
        tree = read_tree(scene.assets.hand)
        self._hand = HandPath(tree, self._config.hand, start)
        self._hand_frames = HandFrames(scene.assets.hand, built.hand_links)
        moving = [link for link, joint in enumerate(tree.joints) if joint.kind != "fixed"]
        self._keypoint_frames = HandFrames(scene.assets.hand, np.array(keypoint_links(moving)))
        self._hand_stands: int | None = None
        self._chains = start.objects[0].astype(np.float64)
        self._robot_target: list[float] | None = None
        self._release_pending = False
        self._row = -1

    def lead(self, motion: Motion) -> None:
        """Say where objects and hand are led in the coming steps, one row a step."""
        self._row = -1
        self._clear_until = 0
        self._length = len(motion)
        self._hand.lead(motion)
        self._hand_changes = self._hand.changes().tolist()
        if self._hand_stands is not None:
            self._hand_stands = -1
        count = motion.objects.shape[1]
        # A servo's target for each step: places in the world; how objects are turned is the guides' to say.
        places = np.zeros((self._length, count, OBJECT_DOF))
        places[..., : OBJECT_DOF // 2] = motion.objects[..., : OBJECT_DOF // 2]
        self._places = places.reshape(self._length, -1)
        self._turns = quaternions_wxyz(motion.objects[..., OBJECT_DOF // 2 :])
        self._still = bool((motion.objects == motion.objects[0]).all())

    def step(self, robot_target: list[float]) -> None:
        """Simulate one step."""
        sim = self._sim or self._running
        self._row = row = self._row + 1
        if self._release_pending:
            sim.free_target()
            self._release_pending = False
        if row >= self._clear_until or robot_target != self._robot_target:
            self._look_ahead(robot_target)
        if robot_target != self._robot_target:
            sim.data.ctrl[sim.scene.robot_ctrl] = robot_target
            self._robot_target = robot_target
        if row == 0 or not self._still:
            sim.data.ctrl[sim.scene.object_ctrl] = self._places[row]
            sim.data.mocap_quat[sim.scene.guides] = self._turns[row]
        if row >= self._clear_until:
            self._place_hand()
        sim.step()

    def _look_ahead(self, robot_target: list[float]) -> None:
        """Note for how many steps the hand is surely out of reach, so that it need not be there."""
        sim, row = self._running, self._row
        data, scene = sim.data, sim.scene
        joints = data.qpos[scene.robot_qpos], data.qvel[scene.robot_qvel]
        links = np.concatenate([data.xpos[scene.robot_links], data.xquat[scene.robot_links][:, XYZW]], axis=1)
        centers = self._hand.centers(row)[:, None]
        reach = np.array([scene.hand_reach])
        clear = int(scene.robot_clearance.clear_steps(joints, links, robot_target, centers, reach)[0])
        worth = min(_WORTH, self._length - row)
        # For few steps, looking again and again would cost more than being there.
        self._clear_until = row + clear if clear >= worth else row
        if self._clear_until > row:
            self._send_hand_away()

    def _place_hand(self) -> None:
        """Put the hand's bodies where it is after the coming step."""
        sim, hand, row = self._running, self._hand, self._row
        if not hand.present_after(row):
            self._send_hand_away()
            return
        if self._hand_stands == row - 1 and not self._hand_changes[row]:
            self._hand_stands = row
            return
        self._hand_stands = row
        data, scene = sim.data, sim.scene
        data.mocap_pos[scene.hand], data.mocap_quat[scene.hand] = self._hand_frames.poses(hand.joints(row))

    def _send_hand_away(self) -> None:
        if self._hand_stands is not None:
            self._running.data.mocap_pos[self._running.scene.hand] = _NOWHERE
            self._hand_stands = None

    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""
        self._release_pending = True

    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""
        sim = self._sim or self._running
        data, scene = sim.data, sim.scene
        if not released and data.ncon == 0:
            return _NOTHING
        sensed = data.sensordata
        touches = scene.touch.read(sensed)
        force = float(touches.robot_object_force)
        x, y, z = data.xpos[scene.gripper].tolist()
        return Contacts(
            robot_hand=bool(touches.robot_hand),
            robot_object=force > 0.0,
            finger_points=self._finger_points(touches.finger_forces) if force > 0.0 else (NO_POINTS, NO_POINTS),
            object_supported=released and bool(touches.supported),
            object_height=float(data.qpos[scene.object_qpos.start + 2]),
            gripper_position=(x, y, z),
            robot_object_force=force,
        )

    def _finger_points(self, forces: npt.NDArray[np.float64]) -> tuple[Points, Points]:
        sim = self._running
        data, fingers = sim.data, sim.scene.fingers
        turns = data.xmat[fingers].reshape(2, 3, 3)
        points = sim.scene.touch.finger_points(data.sensordata, data.xpos[fingers], turns).astype(np.float32)
        left, right = (own[force > 0.0] for own, force in zip(points, forces, strict=True))
        return left, right

    def state(self) -> WorldState:
        """The present state of everything."""
        sim, hand, row = self._running, self._hand, self._row
        data, scene = sim.data, sim.scene
        # A step leaves the frames where they were before it.
        mujoco.mj_kinematics(sim.model, data)
        gripper = np.concatenate([data.xpos[scene.gripper], data.xquat[scene.gripper]])
        # The gripper's pose and behind it the objects'.
        poses = np.concatenate([gripper, data.qpos[scene.object_qpos]]).reshape(-1, 7)
        poses[:, 3:] = bullet_quaternion(poses[:, 3:])
        present = hand.present_after(row)
        return WorldState(
            robot_joint_position=data.qpos[scene.robot_qpos].astype(np.float32),
            robot_joint_velocity=data.qvel[scene.robot_qvel].astype(np.float32),
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
        sim = self._running
        joints: npt.NDArray[np.float64] = sim.data.qpos[sim.scene.robot_qpos].copy()
        return joints

    def object_dof(self) -> npt.NDArray[np.float32]:
        """(n, 6) joint positions that the objects' chains would have (m, rad), float32."""
        sim = self._running
        self._chains = chain_joints(sim.data.qpos[sim.scene.object_qpos].reshape(-1, 7), self._chains)
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
        self._sim = self._scene = None

    @property
    def _running(self) -> Simulation:
        if self._sim is None:
            raise ResetNeededError("the world is empty; call reset() first")
        return self._sim
