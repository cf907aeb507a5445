"""The world simulated by MuJoCo: the same bodies, motors and masks in another engine, several times as fast."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import OBJECT_DOF, CameraConfig, PhysicsConfig, ProtocolConfig
from handover_marl.datasets.scene import Scene
from handover_marl.errors import OptionError
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.protocol.array_rules import ContactArrays
from handover_marl.protocol.contacts import Contacts
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.hand_path import HandPath, keypoint_links, lead_together
from handover_marl.sim.motion import Motion
from handover_marl.sim.mujoco.chain import bullet_quaternion, chain_joints, quaternions_wxyz
from handover_marl.sim.mujoco.dormancy import Dormancy
from handover_marl.sim.mujoco.felt_contacts import contact_arrays, contacts_of
from handover_marl.sim.mujoco.hand_frames import HandFrames
from handover_marl.sim.mujoco.lanes import Lane, Lanes, feel, roll
from handover_marl.sim.mujoco.scene_model import scene_model
from handover_marl.sim.object_path import lead_objects_together
from handover_marl.sim.scene_pictures import Pictures
from handover_marl.sim.world import Postures, Rolled, RollingWorld, Snapshot, WorldState

Array = npt.NDArray[np.float64]

# Where a hand is that is not there (m).
_NOWHERE = (0.0, 0.0, -10.0)


class MujocoWorld(RollingWorld):
    """Robot and objects are simulated, objects once the robot is near one or the hand, or nobody holds them any more.

    The hand follows its targets by kinematics, as in fast physics.

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
        self._row = -1
        self._release_pending = False
        # What leads the model from a row of the motion on, and for how many of these steps no hand is there at first.
        self._controls, self._led_from, self._clear = np.zeros((0, 0)), 0, 0
        self._dormancy: Dormancy | None = None
        self._pictures = Pictures(config)

    def reset(self, scene: Scene, start: Motion) -> None:
        """Put everything at a scene's start."""
        self._lanes.enter(self._lane, scene_model(scene.assets, self._config))
        self._scene = scene
        lane, built = self._lane, self._lane.scene
        lane.controls()[1][built.hand] = _NOWHERE
        tree = read_tree(scene.assets.hand)
        self._path = HandPath(tree, self._config.hand, start)
        self._hand_frames = HandFrames(scene.assets.hand, built.hand_links)
        moving = [link for link, joint in enumerate(tree.joints) if joint.kind != "fixed"]
        self._keypoint_frames = HandFrames(scene.assets.hand, np.array(keypoint_links(moving)))
        self._chains = start.objects[0].astype(np.float64)
        self._dormancy = Dormancy(lane, self._lanes.lone_robot(built.stage), self._config, start)
        self._release_pending = False
        self._is_led = True
        self._go_to(-1)
        self._robot_target: list[float] | None = None

    def lead(self, motion: Motion) -> None:
        """Say where objects and hand are led in the coming steps, one row a step."""
        # All has to have followed the last motion before the next one.
        _follow([self])
        if self._dormancy is not None:
            self._dormancy.turn_over(self._row + 1)
        self._row, self._motion, self._robot_target = -1, motion, None
        self._is_led = False

    def step(self, robot_target: list[float]) -> None:
        """Simulate one step."""
        parts = self._lane.controls()
        self.prepare([self], [robot_target])
        if self._dormancy is None:
            feel([self._lane], [self._hand_within(1)])
            for part, given in zip(parts, self._split(self._coming_controls[0]), strict=True):
                part[:] = given
            self._lane.step()
        self._go_to(self._row + 1)

    @classmethod
    def prepare(cls, worlds: Sequence["MujocoWorld"], robot_targets: Sequence[list[float]]) -> None:
        """As `RollingWorld.prepare`."""
        _begin(worlds, robot_targets)

    @classmethod
    def roll(
        cls, worlds: Sequence["MujocoWorld"], robot_targets: Sequence[list[float]], steps: int, rules: ProtocolConfig
    ) -> Rolled:
        """As `RollingWorld.roll`."""
        cls.prepare(worlds, robot_targets)
        if worlds[0].dormant:
            return _roll_dormant(worlds, steps)
        controls = [world._coming_controls[:steps] for world in worlds]
        lanes = [world._lane for world in worlds]
        feel(lanes, [world._hand_within(steps) for world in worlds])
        rolled = roll(lanes, controls)
        for world in worlds:
            world._row += steps

        def cut(number: int, taken: int) -> None:
            rolled.cut(number, taken)
            worlds[number]._row += taken - steps

        return Rolled(contact_arrays(rolled.felt, rules), cut)

    @property
    def companion(self) -> tuple[object, int]:
        """As `RollingWorld.companion`."""
        return (Dormancy, 0) if self.dormant else (self._lane.running, self._lane.row)

    @property
    def dormant(self) -> bool:
        """As `RollingWorld.dormant`."""
        return self._dormancy is not None

    @property
    def ahead(self) -> int:
        """As `RollingWorld.ahead`."""
        left = len(self._motion) - (self._row + 1)
        return left if self._dormancy is None else min(left, self._dormancy.ahead(self._row + 1))

    @property
    def _hand(self) -> HandPath:
        """The hand, led by the present motion."""
        _follow([self])
        return self._path

    def _go_to(self, row: int) -> None:
        """Take note that steps were taken up to a row."""
        self._row = row
        if self._dormancy is not None:
            self._dormancy.write(row)

    def _wake(self) -> None:
        """Simulate everything from the coming step on."""
        if self._dormancy is not None:
            self._dormancy.wake(self._row)
            self._dormancy, self._robot_target = None, None

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

    def _place_hand(self, clear: int, places: Array, turns: Array) -> int:
        """Put the hand's bodies where they are after each remaining step; nowhere while it is surely out of reach.

        Returns:
            For how many of the first steps they are nowhere.
        """
        places[:clear] = _NOWHERE
        if clear >= len(places):
            return len(places)
        hand, first = self._path, self._row + 1
        changes = hand.changes()[first:]
        for number in range(clear, len(places)):
            if not hand.present_after(first + number):
                places[number] = _NOWHERE
                clear += clear == number
            elif number > clear and not changes[number]:
                places[number], turns[number] = places[number - 1], turns[number - 1]
            else:
                places[number], turns[number] = self._hand_frames.poses(hand.joints(first + number))
        return clear

    @property
    def _coming_controls(self) -> Array:
        """(n, c) what leads the model in the remaining steps of the motion."""
        return self._controls[self._row + 1 - self._led_from :]

    def _hand_within(self, steps: int) -> bool:
        """Whether the hand is somewhere in some coming steps."""
        return self._row + 1 - self._led_from + steps > self._clear

    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""
        self._release_pending = True

    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""
        if self.dormant:
            return Contacts()
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


def _begin(worlds: Sequence[MujocoWorld], robot_targets: Sequence[list[float]]) -> None:
    """Work out what leads the models in the remaining steps of each world's motion, as far as it was not."""
    _follow(worlds)
    for world in worlds:
        if world._release_pending:
            world._wake()
            world._lanes.free_target(world._lane)
            world._release_pending = False
    fresh: dict[tuple[int, ...], list[tuple[MujocoWorld, list[float]]]] = {}
    for world, target in zip(worlds, robot_targets, strict=True):
        if world._dormancy is not None:
            _look_ahead(world, world._dormancy, target)
        if not world.dormant and world._robot_target != target:
            world._robot_target, world._led_from = target, world._row + 1
            model = world._lane.scene.model
            # Models with as many servos and led bodies have these in the same places.
            kind = (len(world._motion) - world._led_from, model.nu, model.nmocap)
            fresh.setdefault(kind, []).append((world, target))
    for group in fresh.values():
        _lead_models([world for world, _ in group], np.array([target for _, target in group]))


def _follow(worlds: Sequence[MujocoWorld]) -> None:
    """Work out where hands, and objects of dormant worlds, are led by the present motions, where it was not."""
    unled = [world for world in worlds if not world._is_led]
    lead_together([world._path for world in unled], [world._motion for world in unled])
    items = [
        (item, world._motion.objects[:, number])
        for world in unled
        if world._dormancy is not None
        for number, item in enumerate(world._dormancy.items)
    ]
    lead_objects_together([item for item, _ in items], [targets for _, targets in items])
    for world in unled:
        world._is_led = True


def _look_ahead(world: MujocoWorld, dormancy: Dormancy, target: list[float]) -> None:
    """Say for how long a world stays dormant, or wake it."""
    row = world._row + 1
    if world._robot_target != target:
        world._robot_target = target
        dormancy.go(row, target, world._path)
    if not dormancy.ahead(row):
        world._wake()


def _roll_dormant(worlds: Sequence[MujocoWorld], steps: int) -> Rolled:
    begun = [world._row for world in worlds]

    def cut(number: int, taken: int) -> None:
        worlds[number]._go_to(begun[number] + taken)

    for number in range(len(worlds)):
        cut(number, steps)
    return Rolled(ContactArrays.none(steps, len(worlds)), cut)


def _lead_models(worlds: Sequence[MujocoWorld], targets: Array) -> None:
    """Work out what leads models with the same servos and led bodies in as many remaining steps of each motion.

    Args:
        worlds: The worlds (w).
        targets: (w, 9) joint targets of their robots (rad, m).
    """
    scene = worlds[0]._lane.scene
    objects = np.stack([world._motion.objects[world._led_from :] for world in worlds])
    parts = [np.stack(part) for part in zip(*(world._lane.controls() for world in worlds), strict=True)]
    controls = np.empty((*objects.shape[:2], sum(part[0].size for part in parts)))
    servos, places, turns = worlds[0]._split(controls)
    # Where the hand is follows for each world.
    places[..., scene.guides, :], turns[:] = parts[1][:, None, scene.guides], parts[2][:, None]
    servos[..., scene.robot_ctrl] = targets[:, None]
    # A servo's target for each step: places in the world; how objects are turned is the guides' to say.
    led = np.zeros(objects.shape)
    led[..., : OBJECT_DOF // 2] = objects[..., : OBJECT_DOF // 2]
    servos[..., scene.object_ctrl] = led.reshape(*objects.shape[:2], -1)
    turns[..., scene.guides, :] = quaternions_wxyz(objects[..., OBJECT_DOF // 2 :])
    for number, (world, clear) in enumerate(zip(worlds, _clear_steps(worlds, targets).tolist(), strict=True)):
        world._controls = controls[number]
        world._clear = world._place_hand(clear, places[number][:, scene.hand], turns[number][:, scene.hand])


def _clear_steps(worlds: Sequence[MujocoWorld], targets: Array) -> npt.NDArray[np.int_]:
    """(w,) for how many of its remaining steps each hand is surely out of reach, so that it need not be there."""
    lanes = [world._lane for world in worlds]
    scene = lanes[0].scene
    frames = [np.concatenate(lane.frames(), axis=1)[scene.stage.links] for lane in lanes]
    links = np.array(frames)[..., [0, 1, 2, 4, 5, 6, 3]]
    joints = np.array([lane.qpos[scene.robot_qpos] for lane in lanes])
    speeds = np.array([lane.qvel[scene.robot_qvel] for lane in lanes])
    centers = np.array([world._path.centers(world._row + 1) for world in worlds])[:, :, None]
    reach = np.array([[lane.scene.hand_reach] for lane in lanes])
    return scene.stage.clearance.clear_steps((joints, speeds), links, targets, centers, reach)[:, 0]
