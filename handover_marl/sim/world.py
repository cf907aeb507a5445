"""What every simulated world can do: be led and stepped, tell its contacts and its state. Mechanics, no rules."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

from handover_marl.config import CameraConfig, ProtocolConfig
from handover_marl.datasets.scene import Scene
from handover_marl.protocol.array_rules import ContactArrays
from handover_marl.protocol.contacts import Contacts
from handover_marl.sim.camera.photo import Photo
from handover_marl.sim.motion import Motion


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


class Postures(NamedTuple):
    """The joints of robot (9,) and hand (51,), None without a hand; float32, m and rad.

    With the models they tell where everything is; reading them costs little.
    """

    robot: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32] | None


class Snapshot(NamedTuple):
    """All joints at one moment, float32, m and rad: with the models they tell where everything is.

    `robot` (9,), `hand` (51,) or None without a hand, `objects` (n, 6).
    """

    robot: npt.NDArray[np.float32]
    hand: npt.NDArray[np.float32] | None
    objects: npt.NDArray[np.float32]


class World(ABC):
    """A table, a Panda, objects and a hand, moved one step (1 ms) at a time."""

    @abstractmethod
    def reset(self, scene: Scene, start: Motion) -> None:
        """Put everything at a scene's start, which is a motion of one row."""

    @abstractmethod
    def lead(self, motion: Motion) -> None:
        """Say where objects and hand are led in the coming steps, one row a step."""

    @abstractmethod
    def step(self, robot_target: list[float]) -> None:
        """Simulate one step; at most as many as the motion has rows.

        Args:
            robot_target: Nine joint targets for the Panda (rad, m), float32 values.
        """

    @abstractmethod
    def contacts(self, released: bool) -> Contacts:
        """The last step's contacts, as far as the rules ask about them."""

    @abstractmethod
    def release_target(self) -> None:
        """Let go of the target object; takes effect in the next step."""

    @abstractmethod
    def state(self) -> WorldState:
        """The present state of everything."""

    @abstractmethod
    def postures(self) -> Postures:
        """The present joints of robot and hand."""

    @abstractmethod
    def exact_joints(self) -> npt.NDArray[np.float64]:
        """The robot's joints (9,) in the engine's own double precision (m, rad), which `state` rounds to float32."""

    @abstractmethod
    def object_dof(self) -> npt.NDArray[np.float32]:
        """(n, 6) joint positions of the objects' chains (m, rad), float32."""

    def snapshot(self) -> Snapshot:
        """The present joints of everything."""
        return Snapshot(*self.postures(), self.object_dof())

    @abstractmethod
    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3) of the present state."""

    @abstractmethod
    def photograph(self, color: bool, at: Snapshot | None = None) -> Photo:
        """What the wrist camera shows, as the engine's own renderer draws it.

        Args:
            color: Whether colours are wanted.
            at: An earlier moment of the same scene; None is the present one.
        """

    @abstractmethod
    def close(self) -> None:
        """Free the simulation."""


class Rolled(NamedTuple):
    """Some steps of worlds that were simulated at once.

    Attributes:
        contacts: What touched, k steps of n worlds.
        cut: Called with a world's number and how many of the steps it is to have taken, fewer than k, at least 1.
    """

    contacts: ContactArrays
    cut: Callable[[int, int], None]


class RollingWorld(World):
    """A world that can take many steps at once, alone or beside others, and go back if they were too many.

    In a dormant one nothing touches anything for some time; it is rolled beside other dormant ones.
    """

    @property
    def dormant(self) -> bool:
        """Whether it is dormant; may change when it is prepared."""
        return False

    @property
    @abstractmethod
    def ahead(self) -> int:
        """How many steps it can be rolled, once it is prepared, before it has to be led or prepared anew."""

    @property
    @abstractmethod
    def companion(self) -> tuple[object, int]:
        """What those worlds have in common that can be rolled at once, and this one's place among them."""

    @classmethod
    def prepare(cls, worlds: Sequence[Self], robot_targets: Sequence[list[float]]) -> None:
        """Work out what `roll` needs for worlds that need not have the same companion: many at once take less time.

        Args:
            worlds: Some.
            robot_targets: As for `roll`.
        """

    @classmethod
    @abstractmethod
    def roll(
        cls, worlds: Sequence[Self], robot_targets: Sequence[list[float]], steps: int, rules: ProtocolConfig
    ) -> Rolled:
        """Simulate as many steps of each of some worlds; none may have fewer left in its motion.

        Args:
            worlds: They have the same companion, and are ordered by their places.
            robot_targets: Nine joint targets for each (rad, m), float32 values.
            steps: How many.
            rules: Where fingers grasp.
        """
