"""Worlds of one engine that are simulated together, with their state and motion as arrays."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handover_marl.config import HAND_DOF, MAX_OBJECTS, N_KEYPOINTS, PANDA_DOF, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.arrays import AnyArray, AnyIndices, AnyIntegers, ArrayFactory, Indices
from handover_marl.simulation.contacts import Contacts, JudgeFunction
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import RolloutWorld


class WorldStateBatch(NamedTuple):
    """State of n worlds, arrays of float32 (world frame, m, rad); quaternions are xyzw.

    Attributes:
        robot_joint_position: Positions (n, 9) of the Pandas' arm and finger joints.
        robot_joint_velocity: Velocities (n, 9) of these joints.
        gripper_pose: Poses (n, 7) of the Pandas' hand links.
        object_poses: Poses (n, 5, 7) of the objects, the target first; zeros for no object.
        hand_present: 1 with a hand, 0 without, (n, 1).
        hand_dof_position: Positions (n, 51) of the hands' joints, zeros without a hand.
        hand_keypoints: Positions (n, 16, 3) of wrists and finger-joint origins, zeros without a hand.
    """

    robot_joint_position: AnyArray
    robot_joint_velocity: AnyArray
    gripper_pose: AnyArray
    object_poses: AnyArray
    hand_present: AnyArray
    hand_dof_position: AnyArray
    hand_keypoints: AnyArray

    @classmethod
    def from_zeros(cls, count: int, arrays: ArrayFactory) -> "WorldStateBatch":
        """Return a state of n worlds with zeros."""
        shapes = ((PANDA_DOF,), (PANDA_DOF,), (7,), (MAX_OBJECTS, 7), (1,), (HAND_DOF,), (N_KEYPOINTS, 3))
        return cls(*(arrays.zeros((count, *shape), "float32") for shape in shapes))


class Worlds(ABC):
    """Interface of n worlds of one engine. The argument `rows` (r,) of methods has the numbers of the worlds."""

    @abstractmethod
    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene and set robot, objects and hand to its start; see `World.reset`."""

    @abstractmethod
    def rollout(
        self,
        rows: AnyIndices,
        reference: ReferenceMotion,
        robot_targets: AnyArray,
        judge: JudgeFunction,
        rules: ProtocolConfig,
    ) -> AnyIntegers:
        """Simulate worlds for the steps of their reference motion, or to their ends.

        Args:
            rows: Numbers (r,) of worlds of running episodes.
            reference: Joint targets of hands and objects in k steps.
            robot_targets: Joint targets (r, 9) of the Pandas (rad, m).
            judge: Function that applies the rules of release and end to some of the r worlds.
            rules: Bounds of the grasp region of the fingers.

        Returns:
            Number (r,) of simulated steps of each world.

        Raises:
            SimulationError: The engine failed; the states of all worlds are invalid.
        """

    @abstractmethod
    def release_targets(self, rows: AnyIndices) -> None:
        """Release the target objects from the hands, from the next step on."""

    @abstractmethod
    def read_state(self, rows: AnyIndices) -> WorldStateBatch:
        """Return the state of r worlds."""

    @abstractmethod
    def are_grasped(self, rows: AnyIndices, rules: ProtocolConfig) -> AnyArray:
        """Return whether both fingers touched the target object in the last physics step, (r,)."""

    @abstractmethod
    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of a world in its last physics step; see `World.read_contacts`."""

    @abstractmethod
    def close(self) -> None:
        """Free the memory of all worlds."""


class HostWorlds(Worlds):
    """Worlds on the processor, with NumPy arrays.

    Args:
        worlds: The worlds, all of one engine.
        arrays: Creator of NumPy arrays.
    """

    def __init__(self, worlds: Sequence[RolloutWorld], arrays: ArrayFactory) -> None:
        self._worlds, self._arrays = worlds, arrays
        self._n_objects = [0] * len(worlds)

    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene and set robot, objects and hand to its start; see `World.reset`."""
        self._worlds[row].reset(scene, start, robot_joints)
        self._n_objects[row] = start.objects.shape[1]

    def rollout(
        self,
        rows: Indices,
        reference: ReferenceMotion,
        robot_targets: AnyArray,
        judge: JudgeFunction,
        rules: ProtocolConfig,
    ) -> AnyIntegers:
        """Simulate worlds for the steps of their reference motion, or to their ends; see `Worlds.rollout`."""
        worlds = [self._worlds[row] for row in rows.tolist()]
        for number, row in enumerate(rows.tolist()):
            worlds[number].set_reference(reference.select(number, self._n_objects[row]))
        return type(worlds[0]).rollout(worlds, robot_targets.tolist(), reference.hand.shape[1], judge, rules)

    def release_targets(self, rows: Indices) -> None:
        """Release the target objects from the hands, from the next step on."""
        for row in rows.tolist():
            self._worlds[row].release_target()

    def read_state(self, rows: Indices) -> WorldStateBatch:
        """Return the state of r worlds."""
        batch = WorldStateBatch.from_zeros(len(rows), self._arrays)
        for number, row in enumerate(rows.tolist()):
            state = self._worlds[row].read_state()
            batch.robot_joint_position[number] = state.robot_joint_position
            batch.robot_joint_velocity[number] = state.robot_joint_velocity
            batch.gripper_pose[number] = state.gripper_pose
            batch.object_poses[number, : len(state.object_poses)] = state.object_poses
            if state.hand_dof_position is not None:
                batch.hand_present[number] = 1.0
                batch.hand_dof_position[number], batch.hand_keypoints[number] = (
                    state.hand_dof_position,
                    state.hand_keypoints,
                )
        return batch

    def are_grasped(self, rows: Indices, rules: ProtocolConfig) -> AnyArray:
        """Return whether both fingers touched the target object in the last physics step, (r,)."""
        return np.array(
            [self._worlds[row].read_contacts(False).both_fingers_touch for row in rows.tolist()], dtype=bool
        )

    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of a world in its last physics step; see `World.read_contacts`."""
        return self._worlds[row].read_contacts(released)

    def close(self) -> None:
        """Free the memory of all worlds."""
        for world in self._worlds:
            world.close()
