"""Base class of data sets of handover scenes, and the classes of their scenes."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl import config
from handover_marl.datasets.splits import N_SCENES, list_split_scenes
from handover_marl.errors import SceneError, check_name
from handover_marl.geometry.panda import PANDA, ROBOTS

#: Height (m) of the table's surface above the world's origin. Added in float32, as in HandoverSim.
TABLE_HEIGHT = np.float32(config.TABLE_HEIGHT)


@dataclass(frozen=True)
class SceneInfo:
    """Description of a handover scene without its motion.

    Attributes:
        scene_id: Number of the scene, 100 * subject + 5 * object + trial.
        name: `<subject>/<sequence>` as in the data set.
        subject: Name of the human giver, e.g. `20200709-subject-01`.
        side: Hand of the giver, "right" or "left".
        object_ids: YCB class numbers (1-21) of the objects on the table, the handed-over one first.
        object_names: YCB class names in the same order, e.g. `003_cracker_box`.
    """

    scene_id: int
    name: str
    subject: str
    side: str
    object_ids: tuple[int, ...]
    object_names: tuple[str, ...]

    @property
    def target_name(self) -> str:
        """Class name of the object that is handed over."""
        return self.object_names[0]


@dataclass(frozen=True)
class SceneAssets:
    """Paths of the URDF files of a scene's bodies.

    Attributes:
        table: URDF of the table.
        panda: URDF of the robot.
        objects: URDFs of the objects, in the order of `SceneInfo.object_names`.
        hand: URDF of the human hand.
    """

    table: Path
    panda: Path
    objects: tuple[Path, ...]
    hand: Path


@dataclass(frozen=True, eq=False)
class Scene:
    """Motion of one recorded handover at 1 kHz in the world frame (m, rad); arrays are read-only.

    Attributes:
        info: Description of the scene.
        dataset: Name of the data set that the scene comes from.
        assets: URDF files of the bodies.
        object_dof: (T, n, 6) float32 position and intrinsic XYZ Euler angles of every object, the
            handed-over one first.
        hand_dof: (T, 51) float32 position of the hand's base, its intrinsic XYZ Euler angles and 45
            finger joint angles.
        hand_first: First frame in which the hand is visible, or None if it never is.
        hand_last: Last frame in which the hand is visible, or None if it never is.
    """

    info: SceneInfo
    dataset: str
    assets: SceneAssets
    object_dof: npt.NDArray[np.float32]
    hand_dof: npt.NDArray[np.float32]
    hand_first: int | None
    hand_last: int | None

    def __post_init__(self) -> None:
        self.object_dof.flags.writeable = False
        self.hand_dof.flags.writeable = False

    @property
    def n_frames(self) -> int:
        """Number of frames T of 1 ms; after the last frame the bodies keep their poses."""
        return len(self.object_dof)

    def is_hand_present(self, frames: npt.NDArray[np.int_]) -> npt.NDArray[np.bool_]:
        """Return a mask of the frames with given numbers in which the human hand is visible."""
        if self.hand_first is None or self.hand_last is None:
            return np.zeros(frames.shape, dtype=bool)
        return (self.hand_first <= frames) & (frames <= self.hand_last)


class Dataset(ABC):
    """1000 numbered handover scenes with their URDF models and robot grasps.

    Args:
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Attributes:
        name: Name of the data set in results.
        robot: Variant of the Panda.

    Raises:
        UnknownNameError: `robot` is not in `ROBOTS`.
    """

    name: ClassVar[str]

    def __init__(self, robot: str = PANDA) -> None:
        check_name("robot", robot, ROBOTS)
        self.robot = robot

    @property
    @abstractmethod
    def panda_urdf(self) -> Path:
        """Path of the robot's URDF; raises `DataNotFoundError` if the file is missing."""

    @abstractmethod
    def load_info(self, scene_id: int) -> SceneInfo:
        """Load the description of a scene by its number, without its motion."""

    @abstractmethod
    def load_scene(self, scene_id: int) -> Scene:
        """Load a scene by its number, with its motion."""

    @abstractmethod
    def load_grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """Load the robot grasps of a YCB class.

        Returns:
            (n, 4, 4) gripper poses in the object's frame (m), or None for a class that is too large
            for the gripper.

        Raises:
            DataNotFoundError: The grasp file is missing.
        """

    @abstractmethod
    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of a YCB class's URDF.

        Raises:
            DataNotFoundError: The file is missing.
        """

    @abstractmethod
    def check_scenes(self, scene_ids: tuple[int, ...]) -> None:
        """Check before a long computation that all files of the given scenes exist.

        Raises:
            DataNotFoundError: A file is missing.
        """

    @abstractmethod
    def compute_fingerprint(self, scene_id: int) -> str:
        """Return a text that changes with the scene's motion, models or robot grasps."""

    @abstractmethod
    def describe_models(self, scene_id: int) -> str:
        """Return a note for results on the origin of a scene's models; empty if there is none."""

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver, "right" or "left"."""
        return self.load_info(scene_id).side

    def list_scenes(self, setup: str, split: str) -> tuple[int, ...]:
        """Return the scene numbers of an official split in ascending order."""
        return list_split_scenes(setup, split, self.find_side)

    @staticmethod
    def check_scene_id(scene_id: int) -> None:
        """Raise `SceneError` unless the number is from 0 to 999."""
        if not 0 <= scene_id < N_SCENES:
            raise SceneError(f"scene {scene_id} does not exist; scenes are numbered 0 to {N_SCENES - 1}")
