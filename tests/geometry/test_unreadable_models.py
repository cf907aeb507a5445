"""Tests that pipes, devices, folders and huge files in place of models and meshes are refused in a short time."""

from pathlib import Path

import pytest

from handover_marl.errors import HandoverError
from handover_marl.geometry.array_cache import load_cached_arrays
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.geometry.model_files.meshes import check_collision_meshes, read_collision_mesh, read_visual_meshes
from handover_marl.geometry.model_files.urdf import list_mesh_references, read_urdf_links, read_urdf_shapes
from tests.unreadable import UNREADABLE, refuses_within

TREE = KinematicTree([])
READERS = [
    read_tree,
    lambda urdf: read_urdf_links(urdf, TREE),
    lambda urdf: read_urdf_shapes(urdf, TREE, "visual"),
    check_collision_meshes,
    list_mesh_references,
]


@pytest.mark.parametrize("kind", UNREADABLE)
def test_unreadable_files(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "cache.npz"
    UNREADABLE[kind](path)
    assert load_cached_arrays(path, ["values"], "field") is None
    (tmp_path / "body.urdf").symlink_to(path)
    for read in READERS:
        with refuses_within(5.0, (HandoverError, ValueError), kind):
            read(tmp_path / "body.urdf")
    for mesh in ("mesh.obj", "mesh.stl"):
        (tmp_path / mesh).symlink_to(path)
        shape = f'<geometry><mesh filename="package://{mesh}"/></geometry>'
        urdf = tmp_path / f"{mesh}.urdf"
        urdf.write_text(f'<robot><link name="b"><collision>{shape}</collision><visual>{shape}</visual></link></robot>')
        for read_mesh in (read_collision_mesh, lambda urdf: read_visual_meshes(urdf, TREE)):
            with refuses_within(5.0, HandoverError, kind):
                read_mesh(urdf)


@pytest.mark.parametrize("content", [b"", b'<?xml version="1.0" encoding="none"?><robot/>', b"<robot/>"])
def test_what_is_no_urdf(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "body.urdf").write_bytes(content)
    for read in (read_tree, check_collision_meshes):
        with pytest.raises(HandoverError, match=r"body\.urdf.*check the file"):
            read(tmp_path / "body.urdf")
