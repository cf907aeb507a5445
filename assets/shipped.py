"""Robot grasps, grasp validations and network weights that are part of the library.

Gripper poses follow the convention of HandoverSim's grasp files: the fingers close along x, the hand approaches along
z, and the Panda's hand link is the gripper frame rotated by -90 degrees about z.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.assets.object_models import DATA_ROOT
from handover_marl.errors import DataFormatError, DataNotFoundError, check_name
from handover_marl.geometry.ycb import CLASS_NAMES

#: Path of the robot grasps, made and validated in simulation by `building/robot_grasps.py`.
GRASPS_PATH = DATA_ROOT / "grasps.npz"
#: YCB classes that are wider than the gripper opens; neither the library nor HandoverSim has grasps.
CLASSES_WITHOUT_GRASPS = ("002_master_chef_can", "036_wood_block")

#: Path of the grasp validations, made by `building/grasp_validations.py`.
VALIDATION_PATH = DATA_ROOT / "grasp_validations.npz"
#: Result of the validation of an object's n grasps, (n, 4). Columns: index of the tilted copy of a
#: known grasp, or -1 for the known grasp itself; number of shaken poses, in and around the grasp,
#: that held the object; number, from 1, of the distance by which the grasp is advanced, 0 for none;
#: number of poses in and around the grasp that kept the object when the person released it.
ValidationRecord = npt.NDArray[np.int16]

#: Path of the weights of the receiver `gaddpg`, trained on scenes that are in the training splits of
#: all setups by `experiments/training/train_gaddpg.py`.
GADDPG_WEIGHTS = DATA_ROOT / "gaddpg.npz"


def find_vision_weights(setup: str) -> Path:
    """Return the path of the weights of the receiver `vision` for an official setup.

    They were trained on the training split of the setup by `experiments/training/train_vision.py`.
    For other setups the file does not exist.
    """
    return DATA_ROOT / f"vision_{setup}.npz"


def load_object_grasps(name: str, path: Path = GRASPS_PATH) -> npt.NDArray[np.float64] | None:
    """Load the gripper poses (100, 4, 4) of a YCB class in the object's frame (m), None for a class without grasps.

    Raises:
        UnknownNameError: The class does not exist.
        DataNotFoundError, DataFormatError: The grasp file is missing or damaged.
    """
    check_name("object", name, CLASS_NAMES.values())
    if name in CLASSES_WITHOUT_GRASPS:
        return None
    return np.asarray(_load_npz(path)[name].astype(np.float64))


def load_validation_record(name: str, path: Path = VALIDATION_PATH) -> ValidationRecord | None:
    """Return the `ValidationRecord` (n, 4) of an object's grasps by its name, or None if there is no such record.

    Raises:
        DataFormatError: The file is damaged.
    """
    record = load_validation_records(path).get(name)
    return None if record is None else record.copy()


def load_validation_records(path: Path) -> Mapping[str, ValidationRecord]:
    """Load all grasp validation records of a file by name; return no records if the file is missing.

    Raises:
        DataFormatError: The file is damaged.
    """
    return _load_npz(path) if path.is_file() else {}


@functools.cache
def _load_npz(path: Path) -> Mapping[str, npt.NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return MappingProxyType({name: archive[name] for name in archive.files})
    except FileNotFoundError as error:
        raise DataNotFoundError(f"{path} is missing; install the library again") from error
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(f"{path}: not a readable file of arrays ({error}); install the library again") from error
