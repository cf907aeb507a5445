"""DexYCB motion in the folder layout of the official HandoverSim data.

<data_dir>/dex-ycb-cache/meta_NNN.json   name, ycb_ids, ycb_grasp_ind, mano_sides, mano_betas
<data_dir>/dex-ycb-cache/pose_NNN.npz    pose_y (T, n, 6), pose_m (T, 1, 51) at 1 kHz in the table frame
<data_dir>/assets/                       URDFs of the objects, hands, Panda and table; grasps/<class>.npy
"""

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF
from handover_marl.datasets.dataset import TABLE_HEIGHT, Dataset
from handover_marl.datasets.official_models import OfficialModels, existing
from handover_marl.datasets.scene import Scene, SceneInfo
from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.files import read_arrays
from handover_marl.models.panda import PANDA
from handover_marl.models.ycb import CLASS_NAMES, SCENE_CLASSES

_LARGEST = 500_000_000  # bytes of a scene's motion, unpacked


class OfficialDataset(Dataset):
    """DexYCB scenes from a folder in HandoverSim's layout.

    Args:
        data_dir: The folder that holds `dex-ycb-cache/` and `assets/`.
        robot: Which Panda stands in the scenes.

    Raises:
        UnknownNameError: There is no such robot.
        DataNotFoundError: The folder or one of these two is missing.
    """

    name = "dexycb"

    def __init__(self, data_dir: Path, robot: str = PANDA) -> None:
        super().__init__(robot)
        self.data_dir = data_dir
        for folder in (data_dir, data_dir / "dex-ycb-cache", data_dir / "assets"):
            if not _is_folder(folder):
                raise DataNotFoundError(
                    f"data folder {folder} does not exist. Give the folder that holds dex-ycb-cache/ and assets/ "
                    "(HandoverSim's handover/data) as data_dir=, --data-dir or HANDOVER_MARL_DATA."
                )
        self._models = OfficialModels(data_dir / "assets", robot)
        self._info = lru_cache(maxsize=None)(self._read_info)

    @property
    def panda_urdf(self) -> Path:
        """The Panda with its gripper, as the reference loads it."""
        return self._models.panda

    def info(self, scene_id: int) -> SceneInfo:
        """A scene's meta file.

        Raises:
            SceneError: No such scene number.
            DataNotFoundError: The meta file is missing.
            DataFormatError: It lacks a key or names an unknown class, subject side or grasped object.
        """
        self.check_scene_id(scene_id)
        return self._info(scene_id)[0]

    def scene(self, scene_id: int) -> Scene:
        """A scene with its motion in the world frame.

        Raises:
            SceneError, DataNotFoundError, DataFormatError: As `info`, and for the pose file and the models.
        """
        self.check_scene_id(scene_id)
        info = self._info(scene_id)[0]
        object_dof, hand_dof = self.motion(scene_id)
        present = np.flatnonzero(hand_dof.any(axis=1))
        object_dof[:, :, 2] += TABLE_HEIGHT
        hand_dof[present, 2] += TABLE_HEIGHT
        return Scene(
            info=info,
            dataset=self.name,
            assets=self._models.of_scene(info),
            object_dof=object_dof,
            hand_dof=hand_dof,
            hand_first=int(present[0]) if len(present) else None,
            hand_last=int(present[-1]) if len(present) else None,
        )

    def motion(self, scene_id: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """A scene's motion in the table's frame: objects (T, n, 6), the given one first, and hand (T, 51).

        Raises:
            SceneError, DataNotFoundError, DataFormatError: As `info`, and for the pose file.
        """
        self.check_scene_id(scene_id)
        return self._read_motion(scene_id, self._info(scene_id)[1])

    def object_urdf(self, object_name: str) -> Path:
        """The model of an object class.

        Raises:
            DataNotFoundError: It is not there.
        """
        return self._models.object(object_name)

    def grasps(self, object_name: str) -> npt.NDArray[np.float64] | None:
        """The official grasps of an object class, or None (master chef can and wood block have none).

        Raises:
            DataNotFoundError: The grasp file of another class is missing.
            UnsafeFileError, DataFormatError: The file holds foreign content or is damaged.
        """
        return self._models.grasps(object_name)

    def check_scenes(self, scene_ids: tuple[int, ...]) -> None:
        """Raise `DataNotFoundError` naming the first missing file of the scenes."""
        for scene_id in scene_ids:
            info = self.info(scene_id)
            self._models.of_scene(info)
            existing(self._pose_path(scene_id))
            self._models.grasp_file(info.target_name)

    def fingerprint(self, scene_id: int) -> str:
        """Hash of the scene's meta, pose and grasp file and its URDFs, and of the sizes of their meshes."""
        digest = hashlib.sha256()
        for path in (self._meta_path(scene_id), existing(self._pose_path(scene_id))):
            digest.update(path.read_bytes())
        self._models.hash_into(digest, self.info(scene_id))
        return digest.hexdigest()[:16]

    def models_in_words(self, scene_id: int) -> str:
        """Which hand the scene is played with, and what else is not HandoverSim's own."""
        return self._models.in_words(self.info(scene_id))

    def _meta_path(self, scene_id: int) -> Path:
        return existing(self.data_dir / "dex-ycb-cache" / f"meta_{scene_id:03d}.json")

    def _pose_path(self, scene_id: int) -> Path:
        return self.data_dir / "dex-ycb-cache" / f"pose_{scene_id:03d}.npz"

    def _read_info(self, scene_id: int) -> tuple[SceneInfo, list[int]]:
        path = self._meta_path(scene_id)
        try:
            meta = json.loads(path.read_text())
            ids = [whole(number) for number in meta["ycb_ids"]]
            grasped, sides, name = whole(meta["ycb_grasp_ind"]), list(meta["mano_sides"]), str(meta["name"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DataFormatError(
                f"{path}: not a scene's meta file ({type(error).__name__}: {error}). It needs name, ycb_ids, "
                "ycb_grasp_ind and mano_sides; copy it again from the HandoverSim data."
            ) from error
        check_meta(path, ids, grasped, sides)
        order = [grasped, *(index for index in range(len(ids)) if index != grasped)]
        ids = [ids[index] for index in order]
        info = SceneInfo(
            scene_id=scene_id,
            name=name,
            subject=name.split("/")[0],
            side=sides[0],
            object_ids=tuple(ids),
            object_names=tuple(CLASS_NAMES[number] for number in ids),
        )
        return info, order

    def _read_motion(self, scene_id: int, order: list[int]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        path = existing(self._pose_path(scene_id))
        arrays = _read_npz(path, ("pose_y", "pose_m"))
        objects, hand = arrays["pose_y"], arrays["pose_m"]
        n_objects = len(order)
        if objects.ndim != 3 or objects.shape[1:] != (n_objects, OBJECT_DOF) or len(objects) == 0:
            raise DataFormatError(
                f"{path}: pose_y has shape {objects.shape}, expected (T, {n_objects}, {OBJECT_DOF}) "
                "for the objects that its meta file lists"
            )
        if hand.shape != (len(objects), 1, HAND_DOF):
            raise DataFormatError(f"{path}: pose_m has shape {hand.shape}, expected ({len(objects)}, 1, {HAND_DOF})")
        if not (np.isfinite(objects).all() and np.isfinite(hand).all()):
            raise DataFormatError(f"{path}: the motion is not finite everywhere; copy the file again")
        return objects[:, order], hand[:, 0].copy()


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def whole(number: object) -> int:
    """A number as it is, if it is whole.

    Raises:
        TypeError: It is something else.
    """
    if type(number) is not int:  # True is an int too
        raise TypeError(f"{number!r} is no whole number")
    return number


def check_meta(path: Path, ids: list[int], grasped: int, sides: list[Any]) -> None:
    """Raise `DataFormatError` naming the file unless a scene can have these objects and hands."""
    unknown = [number for number in ids if number not in SCENE_CLASSES]
    if unknown:
        raise DataFormatError(
            f"{path}: unknown object class {unknown[0]} in ycb_ids; classes of scenes are "
            f"{', '.join(map(str, SCENE_CLASSES))}"
        )
    if not 1 <= len(ids) <= MAX_OBJECTS:
        raise DataFormatError(f"{path}: {len(ids)} objects in ycb_ids, expected 1 to {MAX_OBJECTS}")
    if not 0 <= grasped < len(ids):
        raise DataFormatError(f"{path}: ycb_grasp_ind {grasped} is not an index into {len(ids)} ycb_ids")
    if sides not in (["right"], ["left"]):
        raise DataFormatError(f"{path}: mano_sides is {sides}, expected ['right'] or ['left']")


def _real(array: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    if array.dtype.kind not in "fiu":
        raise TypeError(f"an array of {array.dtype}, expected numbers")
    return array.astype(np.float32)


def _read_npz(path: Path, keys: tuple[str, ...]) -> dict[str, npt.NDArray[np.float32]]:
    try:
        return {key: _real(array) for key, array in read_arrays(path, keys, _LARGEST).items()}
    except Exception as error:  # what NumPy and zipfile raise on damaged bytes has no end
        raise DataFormatError(
            f"{path}: not a readable pose file ({type(error).__name__}: {error}). It may be truncated; "
            "copy or expand it again."
        ) from error
