"""The grasps that ship with the library for its procedural objects.

Made and proven in simulation by `python -m handover_marl.assets.building.build_grasps`. The convention is that of
HandoverSim's grasp files: fingers close along the gripper frame's x, the hand approaches along its z, and the
Panda's hand link is the gripper frame turned by -90 degrees about z.
"""

import functools
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from handover_marl.assets.object_models import DATA_ROOT
from handover_marl.errors import DataFormatError, DataNotFoundError, UnknownNameError
from handover_marl.models.ycb import CLASS_NAMES

GRASPS_PATH = DATA_ROOT / "grasps.npz"
#: Classes that are wider than the gripper opens in every direction; HandoverSim has no grasps for them either.
UNGRASPABLE = ("002_master_chef_can", "036_wood_block")


def load_object_grasps(name: str, path: Path = GRASPS_PATH) -> npt.NDArray[np.float64] | None:
    """The (100, 4, 4) gripper poses `object_from_gripper` (m) for a class name, or None if it has none.

    Raises:
        UnknownNameError: There is no such class.
        DataNotFoundError: The grasp file is missing.
        DataFormatError: It is damaged or lacks the class.
    """
    if name not in CLASS_NAMES.values():
        raise UnknownNameError("object", name, CLASS_NAMES.values())
    if name in UNGRASPABLE:
        return None
    grasps = _load_all(path)
    if name not in grasps:
        raise DataFormatError(
            f"{path}: no grasps for {name}; rebuild with `python -m handover_marl.assets.building.build_grasps`"
        )
    own_copy: npt.NDArray[np.float64] = grasps[name].copy()
    return own_copy


@functools.cache
def _load_all(path: Path) -> MappingProxyType[str, npt.NDArray[np.float64]]:
    if not path.is_file():
        raise DataNotFoundError(
            f"{path} is missing; make it with `python -m handover_marl.assets.building.build_grasps`"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            grasps = {name: archive[name].astype(np.float64) for name in archive.files}
    except Exception as error:
        raise DataFormatError(f"{path}: not a readable grasp file ({error})") from error
    for name, transforms in grasps.items():
        if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not np.isfinite(transforms).all():
            raise DataFormatError(f"{path}: {name} must be finite numbers of shape (n, 4, 4)")
    return MappingProxyType(grasps)
