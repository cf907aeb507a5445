"""Tests that pipes, devices, folders and huge files in place of models and meshes are refused in a short time."""

from collections.abc import Callable
from pathlib import Path

import pytest

from handover_marl.errors import HandoverError
from handover_marl.geometry.array_cache import load_cached_arrays
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.geometry.model_files.meshes import (
    check_collision_meshes,
    read_collision_mesh,
    read_visual_meshes,
)
from handover_marl.geometry.model_files.urdf import list_mesh_references, read_urdf_links, read_urdf_shapes
from tests.unreadable import UNREADABLE, check_refusal, refuses_within, replace_by

TREE = KinematicTree([])
URDF_READERS: dict[str, Callable[[Path], object]] = {
    "tree": read_tree,
    "links": lambda urdf: read_urdf_links(urdf, TREE),
    "shapes": lambda urdf: read_urdf_shapes(urdf, TREE, "visual"),
    "check": check_collision_meshes,
}
MESH_READERS: dict[str, Callable[[Path], object]] = {
    "collision": read_collision_mesh,
    "visual": lambda urdf: read_visual_meshes(urdf, TREE),
}
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


def write_model(folder: Path, mesh: str) -> Path:
    """Write a URDF of one link, its mesh in OBJ format whatever its suffix."""
    (folder / mesh).write_text(TETRAHEDRON)
    shape = f'<geometry><mesh filename="package://{mesh}"/></geometry>'
    urdf = folder / "body.urdf"
    urdf.write_text(
        f'<robot name="body"><link name="body"><collision>{shape}</collision><visual>{shape}</visual></link></robot>'
    )
    return urdf


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("reader", URDF_READERS)
def test_unreadable_urdf(reader: str, kind: str, tmp_path: Path) -> None:
    check_refusal(URDF_READERS[reader], tmp_path / "body.urdf", kind, HandoverError)
    with refuses_within(5.0, ValueError, kind):
        list_mesh_references(tmp_path / "body.urdf")


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("mesh", ["body.obj", "body.stl"])
@pytest.mark.parametrize("reader", MESH_READERS)
def test_unreadable_mesh(reader: str, mesh: str, kind: str, tmp_path: Path) -> None:
    urdf = write_model(tmp_path, mesh)
    replace_by(kind, tmp_path / mesh)
    with refuses_within(5.0, HandoverError, kind):
        MESH_READERS[reader](urdf)


@pytest.mark.parametrize("kind", UNREADABLE)
def test_unreadable_cache_is_computed_again(kind: str, tmp_path: Path) -> None:
    UNREADABLE[kind](tmp_path / "cache.npz")
    assert load_cached_arrays(tmp_path / "cache.npz", ["values"], "field") is None


@pytest.mark.parametrize("content", [b"", b'<?xml version="1.0" encoding="none"?><robot/>', b"<robot/>"])
def test_what_is_no_urdf(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "body.urdf").write_bytes(content)
    for read in (read_tree, check_collision_meshes):
        with pytest.raises(HandoverError, match=r"body\.urdf.*check the file"):
            read(tmp_path / "body.urdf")
