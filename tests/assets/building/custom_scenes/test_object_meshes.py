"""Tests of objects from meshes: damaged meshes are refused or repaired, and failures leave no files."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from handover_marl.assets.building.custom_scenes import CustomSceneFolder, MeshConfig
from handover_marl.assets.building.custom_scenes.object_meshes import make_object_mesh, write_object
from handover_marl.assets.shipped import URDF_NAME
from handover_marl.errors import DataFormatError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from tests.helpers.custom_scenes import make_box

ROUGH: dict[str, Any] = {"concavity": 1.0}
BOX = make_box()
VERTICES, FACES = np.array(BOX.vertices), np.array(BOX.faces)
TURNED = np.where(np.arange(12)[:, None] == 4, FACES[:, ::-1], FACES)


def box(vertices: Any = VERTICES, faces: Any = FACES) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


DAMAGED: dict[str, tuple[trimesh.Trimesh, str]] = {
    "millimeters": (box(1e3 * VERTICES), r"extent must be 0.005 to 0.7 m, got 50 x 50 x 160 m.*unit='mm'"),
    "huge": (box(1e6 * VERTICES), "pass unit or scale"),
    "far from the origin": (box(VERTICES + 3.0), "must be near the origin of its frame, got a distance of 5.2 m"),
    "infinite": (box(np.where(VERTICES > 0.07, np.inf, VERTICES)), "finite vertices"),
    "flat": (box(VERTICES * [1.0, 1.0, 0.0]), "must be a solid body"),
    "no triangle": (box(faces=FACES[:0]), "must have triangles"),
    "only empty triangles": (box(faces=FACES[:, [0, 0, 0]]), "must be a solid body"),
}
REPAIRED: dict[str, tuple[trimesh.Trimesh, str]] = {
    "inverted": (box(faces=FACES[:, ::-1]), "face outwards"),
    "one turned triangle": (box(faces=TURNED), "face outwards"),
    "open": (box(faces=FACES[1:]), "holes filled"),
    "without a side": (box(faces=FACES[2:]), "holes filled|open surface kept"),
    "repeated and empty": (box(faces=np.concatenate([FACES, FACES[:3], [[0, 0, 1]]])), "4 empty or repeated"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_meshes_are_refused(kind: str, tmp_path: Path) -> None:
    mesh, message = DAMAGED[kind]
    with pytest.raises(DataFormatError, match=message):
        CustomSceneFolder(tmp_path / "new").add_object("thing", mesh, MeshConfig(**ROUGH), grasps=0, progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", REPAIRED)
def test_repairs_are_stated(kind: str) -> None:
    mesh, message = REPAIRED[kind]
    item = make_object_mesh(mesh, MeshConfig(mass=0.2, **ROUGH))
    assert any(re.search(message, repair) for repair in item.repairs), item.repairs
    assert item.mesh.volume == pytest.approx(4e-4, rel=0.01)
    assert sum(part.volume for part in item.parts) == pytest.approx(4e-4, rel=0.05)


@pytest.mark.slow
def test_many_triangles_are_simplified() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    item = make_object_mesh(sphere, MeshConfig(**ROUGH))
    assert item.repairs == (f"simplified from {len(sphere.faces)} to {len(item.mesh.faces)} triangles",)
    assert len(item.mesh.faces) <= 20_000
    assert item.mesh.volume == pytest.approx(sphere.volume, rel=0.05)


def test_units_are_applied_when_they_are_given(tmp_path: Path) -> None:
    box(1e3 * VERTICES).export(tmp_path / "box.stl")
    item = make_object_mesh(tmp_path / "box.stl", MeshConfig(unit="mm", scale=0.5, **ROUGH))
    np.testing.assert_allclose(item.mesh.extents, (0.025, 0.025, 0.08))


@pytest.mark.slow
def test_convex_parts_cover_a_body_with_a_hole(tmp_path: Path) -> None:
    ring = trimesh.creation.annulus(0.03, 0.05, 0.02).apply_translation([0.0, 0.0, 0.1])
    item = make_object_mesh(ring, MeshConfig(concavity=0.1))
    assert len(item.parts) > 3
    assert sum(part.volume for part in item.parts) == pytest.approx(ring.volume, rel=0.2)
    write_object(tmp_path, item, MeshConfig())
    center = read_urdf_links(tmp_path / URDF_NAME, read_tree(tmp_path / URDF_NAME))[5].center
    assert center == pytest.approx((0.0, 0.0, 0.1), abs=2e-3), "the mass is in the middle, not at the origin"


@pytest.mark.parametrize("content", [b"", b"no mesh", b"\x00" * 84])
@pytest.mark.parametrize("suffix", [".stl", ".obj", ".xyzw"])
def test_damaged_files(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(content)
    with pytest.raises(DataFormatError, match="mesh"):
        make_object_mesh(path, MeshConfig())
