from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS, GRASPS_PATH, find_object_urdf, load_object_grasps
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.errors import DataFormatError, DataNotFoundError, UnknownNameError
from handover_marl.geometry.ycb import CLASS_NAMES

GRASPABLE = tuple(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)


def _grasps(name: str) -> npt.NDArray[np.float64]:
    grasps = load_object_grasps(name)
    assert grasps is not None
    return grasps


@pytest.mark.parametrize("name", GRASPABLE)
def test_object_lies_between_the_open_fingers(name: str) -> None:
    solid = read_solid(find_object_urdf(name))
    across = np.linspace(-0.04, 0.04, 61)  # between the open fingers, along the gripper frame's x
    depths = np.linspace(0.084, 0.111, 12)  # along the finger pads
    local = np.stack([*np.meshgrid(across, [0.0], depths, indexing="ij"), np.ones((61, 1, 12))], axis=-1)[:, 0]
    for grasp in _grasps(name):
        points = (local.reshape(-1, 4) @ grasp.T)[:, :3]
        outside = (solid.compute_distances(points) > 0.0).reshape(61, 12)
        assert outside[[0, -1]].all()  # where the fingers are
        assert not outside.all()  # between their pads


def test_classes_without_grasps() -> None:
    assert all(load_object_grasps(name) is None for name in CLASSES_WITHOUT_GRASPS)
    with np.load(GRASPS_PATH, allow_pickle=False) as archive:
        assert sorted(archive.files) == sorted(GRASPABLE)


def test_loaded_grasps_are_copies() -> None:
    first = _grasps("025_mug")
    first[:] = 0.0
    assert _grasps("025_mug").any()


def test_bad_names_and_files(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="025_cup"):
        load_object_grasps("025_cup")
    with pytest.raises(DataNotFoundError, match="install the library again"):
        load_object_grasps("025_mug", tmp_path / "none.npz")
    (tmp_path / "damaged.npz").write_bytes(b"PK no archive")
    with pytest.raises(DataFormatError, match="damaged"):
        load_object_grasps("025_mug", tmp_path / "damaged.npz")
