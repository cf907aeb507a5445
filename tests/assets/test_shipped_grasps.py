from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import Delaunay

from handover_marl.assets.building.object_files import load_collision_parts
from handover_marl.assets.object_models import find_object_urdf
from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS, GRASPS_PATH, load_object_grasps
from handover_marl.errors import DataFormatError, DataNotFoundError, UnknownNameError
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.bullet.grasp_validation import BulletGraspValidator

GRASPABLE = tuple(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
PROVEN_AGAIN = ("003_cracker_box", "024_bowl", "025_mug", "037_scissors", "040_large_marker")


def _grasps(name: str) -> npt.NDArray[np.float64]:
    grasps = load_object_grasps(name)
    assert grasps is not None
    return grasps


@pytest.mark.parametrize("name", GRASPABLE)
def test_poses_are_rigid(name: str) -> None:
    grasps = _grasps(name)
    assert grasps.shape == (100, 4, 4)
    assert grasps.dtype == np.float64
    rotations = grasps[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (100, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-6)
    np.testing.assert_array_equal(grasps[:, 3], np.tile([0.0, 0, 0, 1], (100, 1)))


@pytest.mark.parametrize("name", GRASPABLE)
def test_object_lies_between_the_open_fingers(name: str) -> None:
    pytest.importorskip("trimesh")
    hulls = [Delaunay(part.vertices) for part in load_collision_parts(name)]
    across = np.linspace(-0.04, 0.04, 61)  # between the open fingers, along the gripper frame's x
    depths = np.linspace(0.084, 0.111, 12)  # along the finger pads
    local = np.stack([*np.meshgrid(across, [0.0], depths, indexing="ij"), np.ones((61, 1, 12))], axis=-1)[:, 0]
    for grasp in _grasps(name):
        points = (local.reshape(-1, 4) @ grasp.T)[:, :3]
        outside = np.all([hull.find_simplex(points) < 0 for hull in hulls], axis=0).reshape(61, 12)
        assert outside[[0, -1]].all()  # where the fingers are
        assert not outside.all()  # between their pads


@pytest.mark.parametrize("name", GRASPABLE)
def test_grasps_differ(name: str) -> None:
    grasps = _grasps(name)
    tips = grasps[:, :3, 3] + 0.1 * grasps[:, :3, 2]
    apart = np.linalg.norm(tips[:, None] - tips[None], axis=-1)
    turned = np.arccos(np.clip(np.einsum("ai,bi->ab", grasps[:, :3, 2], grasps[:, :3, 2]), -1, 1))
    rolled = np.arccos(np.clip(np.abs(np.einsum("ai,bi->ab", grasps[:, :3, 0], grasps[:, :3, 0])), 0, 1))
    same = (apart < 0.003) & (turned < 0.1) & (rolled < 0.1)
    assert same.sum() == len(grasps)  # each only with itself
    assert np.linalg.norm(grasps[:, :3, 2].mean(axis=0)) < 0.9  # approaches do not all point one way


@pytest.mark.parametrize("name", PROVEN_AGAIN)
def test_shipped_grasps_hold_in_simulation(name: str) -> None:
    trial = BulletGraspValidator(find_object_urdf(name))
    for grasp in _grasps(name)[::20]:
        assert trial.is_collision_free(grasp)
        assert trial.is_stable(grasp)


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
    with pytest.raises(DataNotFoundError, match="build_grasps"):
        load_object_grasps("025_mug", tmp_path / "none.npz")
    damaged, lacking, misshapen = (tmp_path / f"{name}.npz" for name in ("damaged", "lacking", "misshapen"))
    damaged.write_bytes(b"PK no archive")
    np.savez(lacking, **{"024_bowl": np.zeros((1, 4, 4))})
    np.savez(misshapen, **{"025_mug": np.zeros((4, 4))})
    for path in (damaged, lacking, misshapen):
        with pytest.raises(DataFormatError, match=path.stem):
            load_object_grasps("025_mug", path)
