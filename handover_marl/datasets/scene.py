"""A scene: one recorded handover, immutable."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class SceneInfo:
    """What is known of a scene without its motion.

    Attributes:
        scene_id: Number of the scene, 100 * subject + 5 * object + trial.
        name: `<subject>/<sequence>` as in the dataset.
        subject: The person, e.g. `20200709-subject-01`.
        side: `right` or `left`, the hand that gives.
        object_ids: Class numbers (1-21) of the objects on the table, the given one first.
        object_names: Class names in the same order, e.g. `003_cracker_box`.
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
    """The URDF files that show and collide a scene's bodies, objects in the scene's order."""

    table: Path
    panda: Path
    objects: tuple[Path, ...]
    hand: Path


@dataclass(frozen=True, eq=False)
class Scene:
    """One handover's motion at 1 kHz in the world frame (m, rad).

    Attributes:
        info: Who gives what with which hand.
        dataset: Name of the dataset that the scene comes from.
        assets: The bodies' model files.
        object_dof: (T, n, 6) float32, xyz and intrinsic XYZ Euler angles of every object, given one first.
        hand_dof: (T, 51) float32, base xyz, base XYZ Euler angles and 45 finger angles.
        hand_first: First frame with a hand, or None when there is none at all.
        hand_last: Last frame with a hand, or None.
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
        """Number of frames T (1 ms each); after the last one the motion stands still."""
        return len(self.object_dof)

    def hand_present(self, frames: npt.NDArray[np.int_]) -> npt.NDArray[np.bool_]:
        """Whether there is a hand in each of some frames."""
        if self.hand_first is None or self.hand_last is None:
            return np.zeros(frames.shape, dtype=bool)
        return (self.hand_first <= frames) & (frames <= self.hand_last)
