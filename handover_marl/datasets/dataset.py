"""What the library asks of a dataset."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl import config
from handover_marl.datasets.scene import Scene, SceneInfo
from handover_marl.datasets.splits import N_SCENES, split_scenes
from handover_marl.errors import SceneError, UnknownNameError
from handover_marl.models.panda import PANDA, ROBOTS

#: World height of the table frame's origin (m), added in float32 as the reference does.
TABLE_HEIGHT = np.float32(config.TABLE_HEIGHT)


class Dataset(ABC):
    """A thousand numbered scenes with the models and grasps that go with them.

    Args:
        robot: Which Panda stands in the scenes, one of `handover_marl.models.panda.ROBOTS`.

    Attributes:
        name: How results made with it are labelled.
        robot: Which Panda.

    Raises:
        UnknownNameError: There is no such robot.
    """

    name: ClassVar[str]

    def __init__(self, robot: str = PANDA) -> None:
        if robot not in ROBOTS:
            raise UnknownNameError("robot", robot, ROBOTS)
        self.robot = robot

    @abstractmethod
    def info(self, scene_id: int) -> SceneInfo:
        """What is known of a scene without its motion."""

    def side(self, scene_id: int) -> str:
        """The hand that gives, "right" or "left"."""
        return self.info(scene_id).side

    @abstractmethod
    def scene(self, scene_id: int) -> Scene:
        """The scene itself."""

    @abstractmethod
    def grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """(n, 4, 4) gripper poses in the object's frame (m), or None for a class that has none by design.

        Raises:
            DataNotFoundError: A file that should be there is not.
        """

    @abstractmethod
    def object_urdf(self, object_name: str) -> Path:
        """The model file of an object class.

        Raises:
            DataNotFoundError: It is not there.
        """

    @property
    @abstractmethod
    def panda_urdf(self) -> Path:
        """The Panda's model file.

        Raises:
            DataNotFoundError: It is not there.
        """

    @abstractmethod
    def check_scenes(self, scene_ids: tuple[int, ...]) -> None:
        """Raise `DataNotFoundError` if a file of one of the scenes is missing, before hours are spent."""

    @abstractmethod
    def fingerprint(self, scene_id: int) -> str:
        """A short text that changes when the scene's motion, its models or its target's grasps do."""

    @abstractmethod
    def models_in_words(self, scene_id: int) -> str:
        """What results must say of the models that a scene is played with; empty if nothing."""

    def split(self, setup: str, split: str) -> tuple[int, ...]:
        """Scene ids of an official split, ascending."""
        return split_scenes(setup, split, self.side)

    @staticmethod
    def check_scene_id(scene_id: int) -> None:
        """Raise `SceneError` unless the number is one of the thousand."""
        if not 0 <= scene_id < N_SCENES:
            raise SceneError(f"scene {scene_id} does not exist; scenes are numbered 0 to {N_SCENES - 1}")
