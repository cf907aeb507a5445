"""Tests of objects from meshes: damaged meshes are refused or repaired, and failures leave no files."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from handover_marl.assets.building.custom_scenes import CustomSceneFolder, MeshConfig
from handover_marl.assets.building.custom_scenes.object_meshes import make_object_mesh
from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError
from tests.custom_scenes import make_box
from tests.unreadable import check_content_refusal

ROUGH = {"concavity": 1.0}


@pytest.fixture(autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "mesh-cache"))


def box(**changes: Any) -> trimesh.Trimesh:
    mesh = make_box()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    return trimesh.Trimesh(changes.get("vertices", vertices), changes.get("faces", faces), process=False)


def with_vertex(value: float) -> trimesh.Trimesh:
    vertices = np.array(make_box().vertices)
    vertices[3, 1] = value
    return box(vertices=vertices)


def one_turned() -> trimesh.Trimesh:
    faces = np.array(make_box().faces)
    faces[4] = faces[4][::-1]
    return box(faces=faces)


def scaled(factor: float) -> trimesh.Trimesh:
    return box(vertices=np.array(make_box().vertices) * factor)


def shifted(distance: float) -> trimesh.Trimesh:
    return box(vertices=np.array(make_box().vertices) + np.array([distance, 0.0, 0.0]))


FACES = np.array(make_box().faces)

DAMAGED: dict[str, tuple[Callable[[], trimesh.Trimesh], str]] = {
    "millimetres": (lambda: scaled(1000.0), r"largest extent must be 0.005 to 0.7 m, got 50 x 50 x 160 m.*unit='mm'"),
    "centimetres": (lambda: scaled(100.0), r"got 5 x 5 x 16 m in unit 'm'.*pass unit='cm'"),
    "huge": (lambda: scaled(1e6), "pass unit or scale"),
    "tiny": (lambda: scaled(0.01), "largest extent must be"),
    "a point": (lambda: scaled(0.0), "largest extent must be"),
    "far from the origin": (lambda: shifted(3.0), "must be near the origin of its frame, got a distance of 3 m"),
    "NaN": (lambda: with_vertex(np.nan), "vertices must be finite"),
    "infinite": (lambda: with_vertex(np.inf), "vertices must be finite"),
    "flat": (lambda: box(vertices=np.array(make_box().vertices) * [1.0, 1.0, 0.0]), "must be a solid body"),
    "one triangle": (lambda: box(faces=FACES[:1]), "must be a solid body"),
    "a plane": (lambda: box(faces=[[0, 1, 2], [1, 3, 2]]), "must be a solid body"),
    "no triangle": (lambda: box(faces=FACES[:0]), "has no triangles"),
    "only empty triangles": (lambda: box(faces=FACES[:, [0, 0, 0]]), "triangles are empty"),
}
REPAIRED: dict[str, tuple[Callable[[], trimesh.Trimesh], str]] = {
    "inverted": (lambda: box(faces=FACES[:, ::-1]), "flipped"),
    "open": (lambda: box(faces=FACES[1:]), "holes filled"),
    "without a side": (lambda: box(faces=FACES[2:]), "holes filled|open surface kept"),
    "repeated triangles": (
        lambda: box(faces=np.concatenate([FACES, FACES[:3]])),
        "3 empty or repeated",
    ),
    "empty triangles": (
        lambda: box(faces=np.concatenate([FACES, [[0, 0, 1]]])),
        "1 empty or repeated",
    ),
    "one turned triangle": (one_turned, "same winding"),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_meshes_are_refused(kind: str, tmp_path: Path) -> None:
    make, message = DAMAGED[kind]
    with pytest.raises(DataFormatError, match=message):
        CustomSceneFolder(tmp_path / "new").add_object("thing", make(), MeshConfig(**ROUGH), grasps=0, progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", REPAIRED)
def test_repairs_are_stated(kind: str) -> None:
    make, message = REPAIRED[kind]
    item = make_object_mesh(make(), MeshConfig(mass=0.2, **ROUGH))
    assert any(re.search(message, repair) for repair in item.repairs), item.repairs
    assert item.mesh.volume == pytest.approx(4e-4, rel=0.01)
    assert sum(part.volume for part in item.parts) == pytest.approx(4e-4, rel=0.05)


def test_many_triangles_are_simplified() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    item = make_object_mesh(sphere, MeshConfig(max_faces=500, **ROUGH))
    assert item.repairs == (f"simplified from {len(sphere.faces)} to {len(item.mesh.faces)} triangles",)
    assert len(item.mesh.faces) <= 520
    assert item.mesh.volume == pytest.approx(sphere.volume, rel=0.05)


def test_units_are_applied_when_they_are_given(tmp_path: Path) -> None:
    scaled(1000.0).export(tmp_path / "box.stl")
    item = make_object_mesh(tmp_path / "box.stl", MeshConfig(unit="mm", **ROUGH))
    np.testing.assert_allclose(item.mesh.extents, (0.05, 0.05, 0.16))
    half = make_object_mesh(make_box(), MeshConfig(scale=0.5, **ROUGH))
    np.testing.assert_allclose(half.mesh.extents, (0.025, 0.025, 0.08))


def test_convex_parts_cover_a_body_with_a_hole() -> None:
    ring = trimesh.creation.annulus(0.03, 0.05, 0.02)
    item = make_object_mesh(ring, MeshConfig())
    assert len(item.parts) > 3
    assert sum(part.volume for part in item.parts) == pytest.approx(ring.volume, rel=0.15)


@pytest.mark.parametrize("content", [b"", b"no mesh", b"\x89PNG\r\n", b"solid box\nfacet", b"\x00" * 84])
@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".xyzw"])
def test_damaged_files(content: bytes, suffix: str, tmp_path: Path) -> None:
    check_content_refusal(lambda path: make_object_mesh(path, MeshConfig()), tmp_path / f"mesh{suffix}", content)


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(DataNotFoundError, match="does not exist"):
        make_object_mesh(tmp_path / "gone.stl", MeshConfig())
    with pytest.raises(DataFormatError, match="cannot be read"):
        make_object_mesh(tmp_path, MeshConfig())


@pytest.mark.parametrize(
    "options",
    [
        {"unit": "feet"},
        {"scale": 0.0},
        {"scale": -1.0},
        {"scale": np.nan},
        {"scale": True},
        {"mass": 0.0},
        {"mass": 1000.0},
        {"density": -1.0},
        {"mass": 0.1, "density": 100.0},
        {"friction": -0.1},
        {"color": "mauve"},
        {"concavity": 5.0},
        {"max_faces": 3},
    ],
    ids=str,
)
def test_wrong_options(options: dict[str, Any]) -> None:
    with pytest.raises(HandoverError, match=r"must|unknown"):
        MeshConfig(**options)


@pytest.mark.parametrize("name", ["025_mug", "a/b", "", "../x", "x" * 65, ".x", "ä", 3, None])
def test_wrong_names(name: Any, tmp_path: Path) -> None:
    with pytest.raises(HandoverError, match="name must"):
        CustomSceneFolder(tmp_path / "new").add_object(name, make_box(), grasps=0, progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("grasps", [-1, 1.5, True, 10_000])
def test_wrong_numbers_of_grasps_leave_nothing_behind(grasps: Any, tmp_path: Path) -> None:
    with pytest.raises(HandoverError, match="grasps must be an integer"):
        CustomSceneFolder(tmp_path / "new").add_object(
            "box", make_box(), MeshConfig(**ROUGH), grasps=grasps, progress=False
        )
    assert not list(tmp_path.iterdir())
