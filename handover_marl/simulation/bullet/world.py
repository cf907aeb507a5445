"""Base class of the PyBullet worlds."""

from abc import abstractmethod
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError, SimulationError
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.simulation.bullet.bodies import ObjectBody, Workcell
from handover_marl.simulation.bullet.client import (
    CONTACT_BODY_B,
    CONTACT_LINK_A,
    CONTACT_NORMAL_FORCE,
    CONTACT_POSITION_ON_A,
    BulletClient,
    check_model_files,
    connect,
    pybullet_error,
)
from handover_marl.simulation.bullet.rendering import SceneRenderer
from handover_marl.simulation.camera.images import JointSnapshot
from handover_marl.simulation.world import NO_POINTS, Contacts, Points, World, WorldState

# Period at which the window is drawn (steps).
_WINDOW_PERIOD = 20


class BulletWorld(World):
    """Base class of the PyBullet worlds: owns the physics client.

    A window has a second client of its own, so that it does not change the simulation.

    Args:
        config: Constants of the world.
        window: Whether to open PyBullet's window.
    """

    def __init__(self, config: PhysicsConfig, window: bool = False) -> None:
        super().__init__(config)
        self._client: BulletClient = connect()
        self._window: BulletClient | None = connect(window=True) if window else None
        self._window_renderer: SceneRenderer | None = None
        self._n_steps = 0
        self._workcell: Workcell | None = None
        self._release_pending = False

    @contextmanager
    def _start_scene(self, scene: Scene) -> Iterator[None]:
        """Check a scene's files before a `with` block that loads its models, and show it in the window afterwards."""
        for urdf in scene.urdfs:
            check_model_files(urdf)
        self._scene, self._release_pending = scene, False
        try:
            yield
            self._update_window()
        except pybullet_error as error:
            raise _make_connection_error(error) from error

    def release_target(self) -> None:
        """Release the target object from the human hand before the next step."""
        self._release_pending = True

    def read_state(self) -> WorldState:
        """Return the current state of robot, human hand and objects, float32."""
        panda = self._loaded_workcell.panda
        return WorldState.from_bodies(
            panda.read_joint_states(),
            panda.read_link_poses([panda.hand_link])[0],
            self._read_object_poses(),
            self._read_hand_joints(),
            self._read_hand_keypoints(),
        )

    def read_joint_snapshot(self) -> JointSnapshot:
        """Return the current joint positions of robot (9,), human hand (51,) or None, and objects (n, 6), float32."""
        robot = self._loaded_workcell.panda.read_joint_positions()
        return JointSnapshot(robot, self._read_hand_joints(), self._read_object_joints())

    def read_joints_float64(self) -> npt.NDArray[np.float64]:
        """Return the robot's joint positions (9,) in double precision (rad, m)."""
        return self._loaded_workcell.panda.read_joints_float64()

    def close(self) -> None:
        """Disconnect from the PyBullet physics servers."""
        super().close()
        self._client.close()
        if self._window is not None:
            self._window.close()

    @abstractmethod
    def _read_object_joints(self) -> npt.NDArray[np.float32]:
        """Return the joint positions (n, 6) of the objects: xyz (m), intrinsic XYZ Euler angles (rad), float32."""

    @abstractmethod
    def _read_object_poses(self) -> npt.NDArray[np.float32]:
        """Return the world poses (n, 7) of the objects, quaternions xyzw, float32."""

    @abstractmethod
    def _read_hand_joints(self) -> npt.NDArray[np.float32] | None:
        """Return the joint positions (51,) of the human hand (m, rad), float32; None if there is no hand."""

    @abstractmethod
    def _read_hand_keypoints(self) -> npt.NDArray[np.float32] | None:
        """Return world positions (16, 3) of wrist and finger joints (m), float32; None if there is no human hand."""

    @property
    def _loaded_workcell(self) -> Workcell:
        if self._workcell is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        return self._workcell

    def _update_window(self) -> None:
        """Show the current state in PyBullet's window, if there is one."""
        if self._window is None or self._scene is None:
            return
        if self._window_renderer is None or self._window_renderer.scene is not self._scene:
            self._window_renderer = SceneRenderer(self._scene, self._config, self._window)
        self._window_renderer.set_joints(self.read_joint_snapshot())

    def _simulate(self) -> None:
        try:
            self._client.stepSimulation()
            self._n_steps += 1
            if self._n_steps % _WINDOW_PERIOD == 0:
                self._update_window()
        except pybullet_error as error:
            raise _make_connection_error(error) from error

    def _read_contacts(
        self, hand: Collection[int], target: ObjectBody | None, other_ids: set[int], released: bool
    ) -> Contacts:
        """Return the contacts of the last step with a normal force above zero.

        Args:
            hand: PyBullet body numbers of the human hand.
            target: Target object; None while it is not simulated.
            other_ids: PyBullet body numbers of the simulated objects besides the target.
            released: Whether contacts of the target with table and other objects are read.
        """
        panda = self._loaded_workcell.panda
        touching = [point for point in self._client.getContactPoints(panda.id) if point[CONTACT_NORMAL_FORCE] > 0.0]
        hand_forces = [point[CONTACT_NORMAL_FORCE] for point in touching if point[CONTACT_BODY_B] in hand]
        contacts = Contacts(
            robot_touches_hand=bool(hand_forces),
            robot_hand_force=sum(hand_forces),
            robot_touches_others=any(point[CONTACT_BODY_B] in other_ids for point in touching),
        )
        points = [] if target is None else [point for point in touching if point[CONTACT_BODY_B] == target.id]
        if target is None or not (points or released):
            return contacts
        gripper_pose, *finger_poses = panda.read_link_poses([panda.hand_link, *panda.finger_links])
        x, y, z = gripper_pose[:3].tolist()
        return contacts._replace(
            robot_touches_object=bool(points),
            finger_points=_select_finger_points(panda.finger_links, np.array(finger_poses), points),
            object_supported=released and self._is_supported(target, {self._loaded_workcell.table_id, *other_ids}),
            object_height=float(target.read_pose()[2]),
            gripper_position=(x, y, z),
            robot_object_force=sum(point[CONTACT_NORMAL_FORCE] for point in points),
        )

    def _is_supported(self, target: ObjectBody, supports: Collection[int]) -> bool:
        points = self._client.getContactPoints(target.id)
        return any(point[CONTACT_NORMAL_FORCE] > 0.0 and point[CONTACT_BODY_B] in supports for point in points)


def _select_finger_points(
    links: tuple[int, int], poses: Points, points: list[tuple[Any, ...]]
) -> tuple[Points, Points]:
    """Return the points (n, 3) of PyBullet's contacts `points` on each of two Panda links, in that link's frame (m)."""
    on_links = [point for point in points if point[CONTACT_LINK_A] in links]
    if not on_links:
        return NO_POINTS, NO_POINTS
    owners = np.array([links.index(point[CONTACT_LINK_A]) for point in on_links])
    positions = np.array([point[CONTACT_POSITION_ON_A] for point in on_links], dtype=np.float32)
    # One call for both fingers: most of its time does not depend on the number of points.
    local = inverse_transform_points(poses[owners], positions).astype(np.float32)
    return local[owners == 0], local[owners == 1]


def _make_connection_error(error: Exception) -> SimulationError:
    return SimulationError(
        f"PyBullet stopped ({error}); if its window was closed, close() this environment and reset() it again"
    )
