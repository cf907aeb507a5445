"""Base class of data sets of handover scenes, and the classes of their scenes."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl import config
from handover_marl.assets.shipped import CAMERA_PANDA_URDF, PANDA_URDF, TABLE_URDF, find_object_urdf, load_object_grasps
from handover_marl.datasets.splits import N_SCENES, SETUPS, list_split_scenes
from handover_marl.errors import SceneError, check_name
from handover_marl.geometry.panda import PANDA, ROBOTS
from handover_marl.geometry.ycb import CLASS_NAMES

#: Height (m) of the table's surface above the world's origin. Added in float32, as in HandoverSim.
TABLE_HEIGHT = np.float32(config.TABLE_HEIGHT)


@dataclass(frozen=True)
class SceneInfo:
    """Description of a handover scene: giver and objects, without their motion.

    Attributes:
        scene_id: Number of the scene; for DexYCB it is 100 * subject + 5 * object + trial, all counted from 0.
        name: `<subject>/<sequence>` as in the data set.
        side: Hand of the giver, "right" or "left".
        object_ids: Class numbers of the objects on the table, the handed-over one first: 1-21 for YCB
            classes, from 22 on for other classes of the data set.
        object_names: Class names in the same order, e.g. `003_cracker_box`.
    """

    scene_id: int
    name: str
    side: str
    object_ids: tuple[int, ...]
    object_names: tuple[str, ...]

    @property
    def subject(self) -> str:
        """Name of the human giver, e.g. `20200709-subject-01`."""
        return self.name.partition("/")[0]

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
    """Motion of one handover, recorded or generated, at 1 kHz in the world frame (m, rad); arrays are read-only.

    Attributes:
        info: Description of the scene.
        dataset: Name of the data set that the scene comes from.
        assets: URDF files of the bodies.
        object_dof: (T, n, 6) float32 position and intrinsic XYZ Euler angles of every object, the
            handed-over one first.
        hand_dof: (T, 51) float32 position of the hand's base, its intrinsic XYZ Euler angles and 45 finger joint
            angles; zero in frames without a hand.
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

    @property
    def urdfs(self) -> tuple[Path, ...]:
        """URDFs of all bodies: table, robot, objects, hand."""
        return (self.assets.table, self.assets.panda, *self.assets.objects, self.assets.hand)

    def is_hand_present(self, frames: npt.NDArray[np.int_]) -> npt.NDArray[np.bool_]:
        """Return a mask (n,): whether the human hand is visible in each of the frames with indices `frames` (n,)."""
        if self.hand_first is None or self.hand_last is None:
            return np.zeros(frames.shape, dtype=bool)
        return (self.hand_first <= frames) & (frames <= self.hand_last)


class Dataset(ABC):
    """Numbered handover scenes with their URDF models, robot grasps, setups and splits.

    Scene numbers, setups, splits and object classes are HandoverSim's, unless a subclass sets `n_scenes`, `setups` and
    `object_names`, and overrides `list_scenes`. Robot, objects and grasps are the library's, unless a subclass
    overrides `panda_urdf`, `find_object_urdf` and `load_grasps`.

    Args:
        robot: Variant of the Panda, one of `handover_marl.geometry.panda.ROBOTS`.

    Attributes:
        name: Name of the data set in results; `open_dataset(name, source_folder)` opens it again.
        robot: Variant of the Panda.
        source_folder: Folder of the data set, or None if its name suffices to open it again.
        n_scenes: Number of scenes; they are numbered from 0.
        setups: Names of the setups (ways to divide the scenes into train, val and test), the default first. The names
            `s0` to `s3` stand for HandoverSim's setups.
        object_names: Class names of objects by class number: 1-21 for YCB classes, from 22 on for others. Picklable.
        quick_validation: Whether grasps are validated with few simulations, because there are very many classes.

    Raises:
        UnknownNameError: `robot` is not in `ROBOTS`.
    """

    name: str
    source_folder: Path | None = None
    n_scenes: int = N_SCENES
    setups: tuple[str, ...] = SETUPS
    object_names: Mapping[int, str] = dict(CLASS_NAMES)
    quick_validation: bool = False

    def __init__(self, robot: str = PANDA) -> None:
        check_name("robot", robot, ROBOTS)
        self.robot = robot

    @property
    def panda_urdf(self) -> Path:
        """Path of the robot's URDF, by default the library's file."""
        return PANDA_URDF if self.robot == PANDA else CAMERA_PANDA_URDF

    @abstractmethod
    def load_info(self, scene_id: int) -> SceneInfo:
        """Load the description of a scene by its number; raise `SceneError` if the scene does not exist."""

    @abstractmethod
    def load_scene(self, scene_id: int) -> Scene:
        """Load a scene with its motion by its number; raise `SceneError` if the scene does not exist."""

    def load_grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """Load the robot grasps of an object class, e.g. "025_mug", by default the library's.

        Returns:
            (n, 4, 4) gripper poses in the object's frame (m), or None for a class without grasps, such as one that is
            too large for the gripper.

        Raises:
            UnknownNameError, DataNotFoundError: The class is unknown, or its grasp file is missing.
        """
        return load_object_grasps(object_name)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the path of the URDF of an object class, e.g. "025_mug"; by default the library's file.

        Raises:
            UnknownNameError, DataNotFoundError: The class is unknown, or the file is missing.
        """
        return find_object_urdf(object_name)

    @abstractmethod
    def compute_fingerprint(self, scene_id: int) -> str:
        """Return a text that identifies a scene's content: it changes if the motion, models or robot grasps change.

        Evaluations compute this text for all scenes before the first simulation, so missing files are found early.

        Raises:
            DataNotFoundError: A file is missing.
            UnsafeFileError, DataFormatError: The file of robot grasps may run code, or is damaged.
        """

    def describe_models(self, scene_id: int) -> str:
        """Return a note on the origin of a scene's models for reports, e.g. "MANO hand, stand-in grasps", or ""."""
        return ""

    def find_side(self, scene_id: int) -> str:
        """Return the hand of a scene's giver, "right" or "left"."""
        return self.load_info(scene_id).side

    def resolve_setup(self, setup: str | None) -> str:
        """Return `setup`, or the default setup for None; raise `UnknownNameError` if the data set has no such setup."""
        if setup is None:
            return self.setups[0]
        check_name("setup", setup, self.setups)
        return setup

    def list_scenes(self, setup: str | None, split: str) -> tuple[int, ...]:
        """Return the scene numbers of a split ("train", "val" or "test") of a setup in ascending order.

        Raises:
            UnknownNameError: The setup or the split does not exist.
        """
        return list_split_scenes(self.resolve_setup(setup), split, self.find_side)

    def check_scene_id(self, scene_id: int) -> None:
        """Raise `SceneError` unless the scene exists."""
        if not isinstance(scene_id, (int, np.integer)):
            raise SceneError(f"a scene must be given by its number, got {scene_id!r}; pass an integer")
        if not 0 <= scene_id < self.n_scenes:
            raise SceneError(f"scene {scene_id} does not exist; scenes are numbered 0 to {self.n_scenes - 1}")

    def find_assets(self, info: SceneInfo, hand: Path) -> SceneAssets:
        """Return the URDFs of a scene's bodies: the library's table, the data set's robot and objects, and `hand`."""
        objects = tuple(self.find_object_urdf(name) for name in info.object_names)
        return SceneAssets(table=TABLE_URDF, panda=self.panda_urdf, objects=objects, hand=hand)
