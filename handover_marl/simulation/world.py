"""Interface of the simulated worlds: robot, human hand, objects and contacts, without the rules of the task."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import (
    HAND_DOF,
    MAX_OBJECTS,
    N_KEYPOINTS,
    PANDA_DOF,
    CameraConfig,
    PhysicsConfig,
    ProtocolConfig,
)
from handover_marl.datasets.dataset import Scene
from handover_marl.errors import ResetNeededError
from handover_marl.geometry.arrays import AnyArray, AnyIndices, ArrayFactory, get_namespace, make_constant
from handover_marl.simulation.camera.images import CameraImage, JointSnapshot
from handover_marl.simulation.camera.optics import WRIST_CAMERA, Pinhole
from handover_marl.simulation.camera.renderers import check_rendering
from handover_marl.simulation.reference_tracking import ReferenceMotion

if TYPE_CHECKING:
    from handover_marl.simulation.bullet.rendering import SceneRenderer


Points = npt.NDArray[np.float32]
NO_POINTS: Points = np.zeros((0, 3), dtype=np.float32)


class Contacts(NamedTuple):
    """Contacts of robot, hand and objects after one physics step.

    Only contacts with a normal force above zero count. The target object is the one that is handed over. MuJoCo's sums
    of forces leave out the weakest contacts if there are many.

    Attributes:
        robot_touches_hand: Whether the Panda touches the human hand.
        robot_touches_object: Whether the Panda touches the target object.
        finger_points: Contact points of the left and of the right finger with the target object, (n, 3) each, in the
            link frame of that finger (m), float32.
        object_supported: Whether the target object touches the table or another object; False before the release.
        object_height: World z of the target object's origin (m). Valid after the release, and while the robot touches
            the object.
        gripper_position: World position of the Panda's hand link (m). Valid whenever `object_height` is.
        robot_object_force: Sum of the normal forces between Panda and target object (N), not used by the task's rules.
        robot_hand_force: Sum of the normal forces between Panda and human hand (N), not used by the task's rules.
        robot_touches_others: Whether the Panda touches an object besides the target, not used by the task's rules.
    """

    robot_touches_hand: bool = False
    robot_touches_object: bool = False
    finger_points: tuple[Points, Points] = (NO_POINTS, NO_POINTS)
    object_supported: bool = False
    object_height: float = float("inf")
    gripper_position: tuple[float, float, float] = (float("inf"),) * 3
    robot_object_force: float = 0.0
    robot_hand_force: float = 0.0
    robot_touches_others: bool = False

    @property
    def both_fingers_touch(self) -> bool:
        """Whether both fingers of the Panda touch the target object."""
        left, right = self.finger_points
        return len(left) > 0 and len(right) > 0


class RolloutContacts(NamedTuple):
    """Contacts of robot, hand and objects in k physics steps of n worlds, as arrays or tensors.

    Attributes:
        robot_touches_hand: Whether the Panda touches the human hand, (k, n).
        robot_touches_object: Whether the Panda touches the target object, (k, n).
        fingers_touch: Whether the left and the right finger touch the target object, (k, n, 2).
        in_grasp_region: Whether each of these fingers touches the target object inside its grasp region, (k, n, 2).
        object_supported: Whether the target object touches the table or another object, (k, n).
        object_height: World z of the target object's origin (m), (k, n).
        gripper_position: World position of the Panda's hand link (m), (k, n, 3).
    """

    robot_touches_hand: AnyArray
    robot_touches_object: AnyArray
    fingers_touch: AnyArray
    in_grasp_region: AnyArray
    object_supported: AnyArray
    object_height: AnyArray
    gripper_position: AnyArray

    @classmethod
    def without_contacts(cls, steps: int, worlds: int) -> "RolloutContacts":
        """Return contacts of n = `worlds` worlds in k = `steps` physics steps without any contact."""
        shape, default = (steps, worlds), Contacts()
        flags, fingers = np.zeros(shape, dtype=bool), np.zeros((*shape, 2), dtype=bool)
        height, position = np.full(shape, default.object_height), np.full((*shape, 3), default.gripper_position)
        return cls(flags, flags, fingers, fingers, flags, height, position)


class RolloutEnd(NamedTuple):
    """Result of the task's rules for a rollout of n worlds; steps after a release or an episode's end are discarded.

    Attributes:
        steps: Number (n,) of steps that each world keeps; 0 if its episode had ended before.
        released: Whether the object is released in the last of these steps, (n,).
        ended: Whether the episode of each world has ended, (n,).
    """

    steps: AnyArray
    released: AnyArray
    ended: AnyArray


#: Function that applies the task's rules to the next k steps of a rollout. Its arguments are the indices (n,) of worlds
#: in the rollout, and the contacts of these worlds in the k steps. It counts steps from call to call.
JudgeFunction = Callable[[AnyIndices, RolloutContacts], RolloutEnd]


def find_points_in_grasp_region(points: AnyArray, config: ProtocolConfig) -> AnyArray:
    """Return a mask (...) of the points (..., 3), in a finger's frame (m), that are in the grasp region of `config`."""
    lower, upper = (make_constant(bound, points) for bound in (config.region_lower, config.region_upper))
    return get_namespace(points).all((points > lower) & (points < upper), axis=-1)


class WorldState(NamedTuple):
    """State of robot, objects and human hand after a physics step, of one world or of n worlds (n, ...).

    Arrays are float32, in the world frame, in m and rad; quaternions are xyzw.

    Attributes:
        robot_joint_position: Positions (9,) of the Panda's arm and finger joints.
        robot_joint_velocity: Velocities (9,) of these joints.
        gripper_pose: Pose (7,) of the Panda's hand link.
        object_poses: Poses (5, 7) of the objects, the target first; zeros for no object.
        hand_present: 1 with a hand, 0 without, (1,).
        hand_dof_position: Positions (51,) of the human hand's joints, zeros without a hand.
        hand_keypoints: Positions (16, 3) of wrist and 15 finger joints in MANO's order, zeros without a hand.
    """

    robot_joint_position: AnyArray
    robot_joint_velocity: AnyArray
    gripper_pose: AnyArray
    object_poses: AnyArray
    hand_present: AnyArray
    hand_dof_position: AnyArray
    hand_keypoints: AnyArray

    @classmethod
    def from_bodies(
        cls,
        robot_joints: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]],
        gripper_pose: npt.NDArray[np.float32],
        object_poses: npt.NDArray[np.float32],
        hand_joints: npt.NDArray[np.float32] | None,
        hand_keypoints: npt.NDArray[np.float32] | None,
    ) -> "WorldState":
        """Return the state of one world; the arguments have the units and frames of the attributes.

        `robot_joints` are positions (9,) and velocities (9,), `object_poses` (m, 7) are the poses of m objects.
        `hand_joints` (51,) and `hand_keypoints` (16, 3) are None if there is no human hand.
        """
        poses = np.zeros((MAX_OBJECTS, 7), dtype=np.float32)
        poses[: len(object_poses)] = object_poses
        return cls(
            *robot_joints,
            gripper_pose,
            poses,
            np.array([hand_joints is not None], dtype=np.float32),
            np.zeros(HAND_DOF, dtype=np.float32) if hand_joints is None else hand_joints,
            np.zeros((N_KEYPOINTS, 3), dtype=np.float32) if hand_keypoints is None else hand_keypoints,
        )

    @classmethod
    def from_zeros(cls, count: int, arrays: ArrayFactory) -> "WorldState":
        """Return the state of `count` worlds in which all values are zero; `arrays` creates its arrays."""
        shapes = ((PANDA_DOF,), (PANDA_DOF,), (7,), (MAX_OBJECTS, 7), (1,), (HAND_DOF,), (N_KEYPOINTS, 3))
        return cls(*(arrays.zeros((count, *shape), "float32") for shape in shapes))


class World(ABC):
    """Simulated table, Panda, objects and human hand, advanced in steps of 1 ms.

    Args:
        config: Constants of the world.
    """

    def __init__(self, config: PhysicsConfig) -> None:
        self._config = config
        self._scene: Scene | None = None
        self._renderer: SceneRenderer | None = None

    @abstractmethod
    def reset(self, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene, and set robot, objects and human hand to their start positions.

        Args:
            scene: Scene to load.
            start: Reference motion of one step: the joint positions of human hand and objects at the start.
            robot_joints: Nine joint positions of the robot at the start (rad, m).
        """

    @abstractmethod
    def set_reference(self, motion: ReferenceMotion) -> None:
        """Set the joint targets of human hand and objects in the coming steps; row k of `motion` is for step k."""

    @abstractmethod
    def step(self, robot_target: list[float]) -> None:
        """Simulate the next physics step of 1 ms, for the next row of the motion that `set_reference` has set.

        At most as many steps can be simulated as that motion has rows.

        Args:
            robot_target: Nine joint targets of the Panda (rad, m), float32 values.
        """

    def rollout(self, robot_target: list[float], steps: int, judge: JudgeFunction, rules: ProtocolConfig) -> int | None:
        """Simulate up to `steps` physics steps in one call if the engine can, as MuJoCo can; else do nothing.

        Args:
            robot_target: Nine joint targets of the Panda (rad, m), float32 values.
            steps: Number of physics steps, at most the rows of the reference motion.
            judge: Function that applies the rules of release and end to contacts; its index for this world is 0.
            rules: Rules of the protocol, of which only the grasp region of the fingers is used here.

        Returns:
            Number of simulated steps, fewer than `steps` if the episode ends; None if the engine has no such call.
        """
        return None

    @abstractmethod
    def read_contacts(self, released: bool) -> Contacts:
        """Return the contacts of robot, hand and objects in the last physics step.

        Args:
            released: Whether the person has released the target object. Its contacts with table and other objects are
                read only then.
        """

    @abstractmethod
    def release_target(self) -> None:
        """Release the target object from the human hand before the next step."""

    @abstractmethod
    def read_state(self) -> WorldState:
        """Return the current state of robot, human hand and objects, float32."""

    @abstractmethod
    def read_joints_float64(self) -> npt.NDArray[np.float64]:
        """Return the robot's joint positions (9,) in the engine's double precision (rad, m)."""

    @abstractmethod
    def read_joint_snapshot(self) -> JointSnapshot:
        """Return the current joint positions of robot (9,), human hand (51,) or None, and objects (n, 6), float32."""

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """Render the current world state as an RGB image (height, width, 3), uint8, with PyBullet's renderer."""
        return self._get_scene_renderer().render_overview(self.read_joint_snapshot(), camera)

    def render_camera(self, snapshot: JointSnapshot | None, color: bool, camera: Pinhole = WRIST_CAMERA) -> CameraImage:
        """Render an image of a camera with PyBullet's renderer, whichever engine simulates.

        Args:
            snapshot: Joint positions of all bodies of the scene, e.g. earlier ones; None for the current ones.
            color: Whether to render colors.
            camera: The camera; default: HandoverSim's wrist camera.
        """
        return self._get_scene_renderer().render(snapshot or self.read_joint_snapshot(), color, camera)

    def close(self) -> None:
        """Free the memory of the simulation."""
        if self._renderer is not None:
            self._renderer.close()
        self._scene = self._renderer = None

    def _get_scene_renderer(self) -> "SceneRenderer":
        """Return the renderer of the current scene, which has its own physics client; create it at the first image."""
        if self._scene is None:
            raise ResetNeededError("the world has no scene; call reset() first")
        if self._renderer is None or self._renderer.scene is not self._scene:
            check_rendering()
            # Imported here: only rendering needs PyBullet.
            from handover_marl.simulation.bullet.rendering import SceneRenderer

            if self._renderer is not None:
                self._renderer.close()
            self._renderer = SceneRenderer(self._scene, self._config)
        return self._renderer
