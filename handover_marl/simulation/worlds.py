"""Batch of worlds that one engine simulates together; arrays have one row for each world."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from handover_marl.config import ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.arrays import AnyArray, AnyIndices, AnyIntegers, Indices
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import Contacts, JudgeFunction, RolloutWorld, WorldState


class Worlds(ABC):
    """Interface of a batch of n worlds that one engine simulates together.

    Methods apply to the r worlds whose indices are in their argument `rows` (r,); other arrays have r rows.
    """

    @abstractmethod
    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene into the world with index `row`, and set all bodies to their start; see `World.reset`."""

    @abstractmethod
    def rollout(
        self,
        rows: AnyIndices,
        reference: ReferenceMotion,
        robot_targets: AnyArray,
        judge: JudgeFunction,
        rules: ProtocolConfig,
    ) -> AnyIntegers:
        """Simulate r worlds for all steps of a reference motion, or until their episodes end.

        Args:
            rows: Indices (r,) of worlds of running episodes.
            reference: Joint targets of hands and objects of these worlds in k steps.
            robot_targets: Joint targets (r, 9) of the Pandas (rad, m).
            judge: Function that applies the rules of release and end to the contacts of some of the r worlds.
            rules: Bounds of the grasp region of the fingers.

        Returns:
            Number (r,) of simulated steps of each world.
        """

    @abstractmethod
    def release_targets(self, rows: AnyIndices) -> None:
        """Release the target objects of the worlds `rows` (r,) from the human hands before the next step."""

    @abstractmethod
    def read_state(self, rows: AnyIndices) -> WorldState:
        """Return the states (r, ...) of the worlds `rows` (r,)."""

    @abstractmethod
    def are_grasped(self, rows: AnyIndices) -> AnyArray:
        """Return a mask (r,) of the worlds `rows` whose fingers both touched the target object in the last step."""

    @abstractmethod
    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of world `row` in its last step, as `World.read_contacts` does."""

    @abstractmethod
    def close(self) -> None:
        """Free the memory of all worlds."""


class HostWorlds(Worlds):
    """Batch of worlds on the CPU, with NumPy arrays.

    Args:
        worlds: The worlds, all of one engine.
    """

    def __init__(self, worlds: Sequence[RolloutWorld]) -> None:
        self._worlds = worlds
        self._n_objects = [0] * len(worlds)

    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        """Load a scene into the world with index `row`, and set all bodies to their start; see `World.reset`."""
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
        """Simulate r worlds for all steps of `reference`, or until their episodes end; return step counts (r,)."""
        worlds = [self._worlds[row] for row in rows.tolist()]
        for number, row in enumerate(rows.tolist()):
            worlds[number].set_reference(reference.select(number, self._n_objects[row]))
        return type(worlds[0]).rollout(worlds, robot_targets.tolist(), reference.hand.shape[1], judge, rules)

    def release_targets(self, rows: Indices) -> None:
        """Release the target objects of the worlds `rows` (r,) from the human hands before the next step."""
        for row in rows.tolist():
            self._worlds[row].release_target()

    def read_state(self, rows: Indices) -> WorldState:
        """Return the states (r, ...) of the worlds `rows` (r,)."""
        states = [self._worlds[row].read_state() for row in rows.tolist()]
        return WorldState(*map(np.stack, zip(*states, strict=True)))

    def are_grasped(self, rows: Indices) -> AnyArray:
        """Return a mask (r,) of the worlds `rows` whose fingers both touched the target object in the last step."""
        return np.array(
            [self._worlds[row].read_contacts(False).both_fingers_touch for row in rows.tolist()], dtype=bool
        )

    def read_contacts(self, row: int, released: bool) -> Contacts:
        """Return the contacts of world `row` in its last step, as `World.read_contacts` does."""
        return self._worlds[row].read_contacts(released)

    def close(self) -> None:
        """Free the memory of all worlds."""
        for world in self._worlds:
            world.close()
