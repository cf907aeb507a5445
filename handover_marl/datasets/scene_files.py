"""Reader of the two files of a scene in HandoverSim's cache `dex-ycb-cache/`.

meta_NNN.json   name, ycb_ids, ycb_grasp_ind, mano_sides, mano_betas
pose_NNN.npz    pose_y (T, n, 6), pose_m (T, 1, 51) at 1 kHz in the table's frame (m, rad)
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.config import HAND_DOF, MAX_OBJECTS, OBJECT_DOF
from handover_marl.datasets.dataset import SceneInfo
from handover_marl.errors import DataFormatError
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES

#: Folder of the motion files within a data folder.
CACHE_FOLDER = "dex-ycb-cache"
#: Largest accepted size of a scene's motion (bytes, unpacked).
MAX_MOTION_BYTES = 500_000_000
_MAX_META_BYTES = 1_000_000


def read_scene_info(path: Path, scene_id: int) -> tuple[SceneInfo, list[int]]:
    """Read the meta file of a scene.

    Returns:
        Description of the scene, and the indices of its objects in the pose file, the handed-over
        one first.

    Raises:
        DataFormatError: The file lacks a key or has an invalid object or hand.
    """
    try:
        meta = json.loads(read_plain_file(path, _MAX_META_BYTES))
        ids, grasped, sides, name = (meta[key] for key in ("ycb_ids", "ycb_grasp_ind", "mano_sides", "name"))
        check_scene_meta(path, ids, grasped, sides)
    except DataFormatError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataFormatError(
            f"{path}: not a scene's meta file ({type(error).__name__}: {error}). It needs name, ycb_ids, "
            "ycb_grasp_ind and mano_sides; copy it again from the HandoverSim data."
        ) from error
    order = [grasped, *(index for index in range(len(ids)) if index != grasped)]
    ids = [ids[index] for index in order]
    names = tuple(CLASS_NAMES[number] for number in ids)
    return SceneInfo(scene_id, name, sides[0], tuple(ids), names), order


def read_scene_motion(path: Path, order: list[int]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Read the motion of the objects (T, n, 6), in the order from `read_scene_info`, and of the hand (T, 51).

    Raises:
        DataFormatError: The file is damaged or has another number of objects.
    """
    try:
        arrays = read_arrays(path, ("pose_y", "pose_m"), MAX_MOTION_BYTES)
        objects, hand = (arrays[name].astype(np.float32) for name in ("pose_y", "pose_m"))
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(
            f"{path}: not a readable pose file ({type(error).__name__}: {error}). It may be truncated; "
            "copy or expand it again."
        ) from error
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


def check_scene_meta(path: Path, ids: list[int], grasped: int, sides: list[Any]) -> None:
    """Check class numbers, index of the handed-over object and hand (["right"] or ["left"]) of a meta file.

    Raises:
        DataFormatError: A scene cannot have these objects or hands.
    """
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
