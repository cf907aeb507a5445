"""Base class of the PyBullet worlds, and the world whose states are bit-equal to HandoverSim."""

from abc import abstractmethod
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError, SimulationError
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.simulation.bullet.bodies import HandBody, ObjectBody, Workcell, compute_object_masks, load_workcell
from handover_marl.simulation.bullet.body import InitialState
from handover_marl.simulation.bullet.client import (
    BulletClient,
    check_model_files,
    connect,
    pause_window_rendering,
    pybullet_error,
)
from handover_marl.simulation.bullet.rendering import (
    SceneRenderer,
    label_bodies,
    render_overview,
    render_wrist_camera,
)
from handover_marl.simulation.camera.frames import CameraImage
from handover_marl.simulation.camera.renderers import SceneRendererCache
from handover_marl.simulation.contacts import NO_POINTS, Contacts, Points
from handover_marl.simulation.kinematic_paths import ReferenceMotion
from handover_marl.simulation.world import AgentJoints, JointSnapshot, World, WorldState

# Fields of a PyBullet contact point.
_BODY_B, _LINK_A, _POSITION_ON_A, _NORMAL_FORCE = 2, 3, 5, 9


class BulletWorld(World):
    """Base class of the PyBullet worlds: owns the physics client.

    Args:
        config: Constants of the world.
        window: Whether to open PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        self._config = config
        self._client: BulletClient = connect(window)
        self._scene: Scene | None = None
        self._workcell: Workcell | None = None
        self._release_pending = False
        self._scene_renderers: SceneRendererCache | None = None

    @contextmanager
    def _start_scene(self, scene: Scene) -> Iterator[None]:
        """Check a scene's files, and pause the window while its models are loaded in this context.

        Raises:
            OSError: The URDF file of a model cannot be read.
            SimulationError: A file is damaged, a model cannot be loaded, or PyBullet's window was closed.
        """
        for urdf in scene.urdfs:
            check_model_files(urdf, urdf.stat().st_mtime_ns)
        self._scene, self._release_pending = scene, False
        try:
            with pause_window_rendering(self._client):
                yield
        except pybullet_error as error:
            raise _make_connection_error(error) from error

    def release_target(self) -> None:
        """Release the target object from the human hand, from the next step on."""
        self._release_pending = True

    def read_state(self) -> WorldState:
        """Return the current state of robot, objects and human hand."""
        panda = self._loaded_workcell.panda
        position, velocity = panda.read_joint_states()
        return WorldState(
            robot_joint_position=position,
            robot_joint_velocity=velocity,
            gripper_pose=panda.read_link_poses([panda.hand_link])[0],
            object_poses=self._read_object_poses(),
            hand_dof_position=self._read_hand_joints(),
            hand_keypoints=self._read_hand_keypoints(),
        )

    def read_agent_joints(self) -> AgentJoints:
        """Return the current joint positions of robot and human hand."""
        return AgentJoints(self._loaded_workcell.panda.read_joint_positions(), self._read_hand_joints())

    def read_joints_float64(self) -> npt.NDArray[np.float64]:
        """Return the robot's joint positions (9,) in double precision (rad, m)."""
        return self._loaded_workcell.panda.read_joints_float64()

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """Render the current world state as an RGB image (height, width, 3), uint8."""
        return render_overview(self._client, camera)

    def close(self) -> None:
        """Disconnect from the PyBullet physics server."""
        if self._scene_renderers is not None:
            self._scene_renderers.close()
        self._client.close()

    @abstractmethod
    def _read_object_poses(self) -> npt.NDArray[np.float32]:
        """Return the world poses (n, 7) of the objects, float32."""

    @abstractmethod
    def _read_hand_joints(self) -> npt.NDArray[np.float32] | None:
        """Return the joint positions (51,) of the hand (m, rad), float32; None without a hand."""

    @abstractmethod
    def _read_hand_keypoints(self) -> npt.NDArray[np.float32] | None:
        """Return the world keypoints (16, 3) of wrist and fingers (m); None without a hand."""

    @property
    def _loaded_workcell(self) -> Workcell:
        if self._workcell is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        return self._workcell

    @property
    def _scene_renderer(self) -> SceneRenderer:
        """Renderer of the current scene in a separate physics client."""
        self._scene_renderers = self._scene_renderers or SceneRendererCache(self._config)
        return self._scene_renderers.get(self._scene)

    def _simulate(self) -> None:
        try:
            self._client.stepSimulation()
        except pybullet_error as error:
            raise _make_connection_error(error) from error

    def _read_contacts(
        self, hand: Collection[int], target: ObjectBody | None, others: set[int], released: bool
    ) -> Contacts:
        """Return the contacts of the last step with a normal force above zero.

        Args:
            hand: PyBullet body numbers of the human hand.
            target: Target object; None while it is not simulated.
            others: PyBullet body numbers of the simulated objects besides the target.
            released: Whether contacts of the target with table and other objects are read.
        """
        panda = self._loaded_workcell.panda
        touching = [point for point in self._client.getContactPoints(panda.id) if point[_NORMAL_FORCE] > 0.0]
        hand_forces = [point[_NORMAL_FORCE] for point in touching if point[_BODY_B] in hand]
        robot_touches_hand, robot_hand_force = bool(hand_forces), sum(hand_forces)
        robot_touches_others = any(point[_BODY_B] in others for point in touching)
        points = [] if target is None else [point for point in touching if point[_BODY_B] == target.id]
        if target is None or not (points or released):
            return Contacts(
                robot_touches_hand=robot_touches_hand,
                robot_hand_force=robot_hand_force,
                robot_touches_others=robot_touches_others,
            )
        gripper_pose, *finger_poses = panda.read_link_poses([panda.hand_link, *panda.finger_links])
        x, y, z = gripper_pose[:3].tolist()
        return Contacts(
            robot_touches_hand=robot_touches_hand,
            robot_touches_object=bool(points),
            finger_points=_select_finger_points(panda.finger_links, np.array(finger_poses), points),
            object_supported=released and self._is_supported(target, {self._loaded_workcell.table_id, *others}),
            object_height=float(target.read_pose()[2]),
            gripper_position=(x, y, z),
            robot_object_force=sum(point[_NORMAL_FORCE] for point in points),
            robot_hand_force=robot_hand_force,
            robot_touches_others=robot_touches_others,
        )

    def _is_supported(self, target: ObjectBody, supports: Collection[int]) -> bool:
        points = self._client.getContactPoints(target.id)
        return any(point[_NORMAL_FORCE] > 0.0 and point[_BODY_B] in supports for point in points)


def _select_finger_points(
    links: tuple[int, int], poses: Points, points: list[tuple[Any, ...]]
) -> tuple[Points, Points]:
    """Return the contact points (n, 3) on each of two Panda links, in the frame of that link (m), float32."""
    on_links = [point for point in points if point[_LINK_A] in links]
    if not on_links:
        return NO_POINTS, NO_POINTS
    owners = np.array([links.index(point[_LINK_A]) for point in on_links])
    positions = np.array([point[_POSITION_ON_A] for point in on_links], dtype=np.float32)
    # One call for both fingers: most of its time does not depend on the number of points.
    local = inverse_transform_points(poses[owners], positions).astype(np.float32)
    return local[owners == 0], local[owners == 1]


def _make_connection_error(error: Exception) -> SimulationError:
    return SimulationError(
        f"PyBullet stopped ({error}); if its window was closed, close() this environment and reset() it again"
    )


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
        """Load a scene and set robot, objects and hand to its start, see `World.reset`."""
        with self._start_scene(scene):
            panda = replace(self._config.panda, start_joints=tuple(robot_joints))
            self._workcell = load_workcell(self._client, scene.assets, replace(self._config, panda=panda))
            states, masks = start.objects[0].tolist(), compute_object_masks(scene.info.object_ids)
            self._objects = [
                ObjectBody(self._client, urdf, mask, InitialState(state), self._config.objects)
                for urdf, mask, state in zip(scene.assets.objects, masks, states, strict=True)
            ]
            self._hand = None
            self._update_hand(start.list_hand_targets()[0])

    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of hand and objects for the coming steps, one row per step."""
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

        Contacts of the target object with table and other objects are read only if `released`.
        """
        hand = () if self._hand is None else (self._hand.id,)
        return self._read_contacts(hand, self._objects[0], {body.id for body in self._objects[1:]}, released)

    def read_object_joints(self) -> npt.NDArray[np.float32]:
        """Return the joint positions (n, 6) of n objects: xyz (m), Euler angles (rad), float32."""
        return np.stack([body.read_joint_positions() for body in self._objects])

    def render_wrist_camera(self, color: bool, at: JointSnapshot | None = None) -> CameraImage:
        """Render an image of the wrist camera, at the current or an earlier state of the scene."""
        if at is not None:
            return self._scene_renderer.render_wrist_camera(at, color)
        workcell, objects = self._loaded_workcell, [body.id for body in self._objects]
        hand = None if self._hand is None else self._hand.id
        labels = label_bodies(workcell.table_id, workcell.panda.id, objects, hand)
        return render_wrist_camera(self._client, workcell.panda, labels, color)

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
