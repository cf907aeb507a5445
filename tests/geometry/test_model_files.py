"""Tests of OBJ and URDF files: forms of the formats, ranges of numbers, unreadable files, and convex hulls."""

import codecs
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

import handover_marl.assets
from handover_marl.errors import DataFormatError, HandoverError, SimulationError
from handover_marl.geometry.array_cache import load_cached_arrays
from handover_marl.geometry.kinematic_tree import KinematicTree, read_tree
from handover_marl.geometry.model_files.meshes import (
    check_collision_meshes,
    compute_convex_hull,
    read_collision_mesh,
    read_visual_meshes,
    select_extreme_points,
)
from handover_marl.geometry.model_files.obj_files import check_mesh, read_obj
from handover_marl.geometry.model_files.urdf import list_mesh_references, read_urdf_links, read_urdf_shapes
from handover_marl.geometry.model_files.urdf_xml import URDF_RANGES, parse_urdf
from tests.helpers.unreadable import UNREADABLE, refuses_within

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "mesh.obj"
    path.write_text(text)
    return path


def test_every_form_of_the_format(tmp_path: Path) -> None:
    """A box in unusual forms of the format equals the plain one."""
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    lines = ["# body", "mtllib none.mtl", "o body", "usemtl v", "vn 0 0 1", "vt 0.5 0.5"]
    lines += [f"v {x!r} {y!r} {z!r} 0.1 0.2 0.3" for x, y, z in box.vertices.tolist()]
    lines += ["f " + " ".join(f"{corner - 8}/-1/-1" for corner in face) for face in box.faces.tolist()]
    text = "\n".join(f"  {line} # v 1 2 3" for line in lines).replace("f ", "f \\\n")
    for separator, line_end, mark in ((" ", "\n", b""), ("\t", "\r\n", codecs.BOM_UTF8), (" \t ", "\r", b"")):
        path = tmp_path / "box.obj"
        path.write_bytes(mark + text.replace(" ", separator).replace("\n", line_end).encode())
        found = read_obj(path)
        np.testing.assert_array_equal(found.vertices, box.vertices)
        np.testing.assert_array_equal(found.faces, box.faces)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        (f"{TRIANGLE}v nan 0 0\nf 1 2 3\n", "not finite"),
        (f"{TRIANGLE}v 0 0\nf 1 2 3\n", "three numbers"),
        (f"{TRIANGLE}v 0 0 1\nf 1 2 3\nf 2 3", "at least three corners"),
        (f"{TRIANGLE}f 1 2 4\n", "not there"),
        (f"{TRIANGLE}f 1 2 -4\n", "not there"),
        (f"{TRIANGLE}f one two three\n", "not a readable OBJ file"),
    ],
)
def test_damaged_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_obj(write(tmp_path, text))


BODY = f"{TRIANGLE}v 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize(
    "text",
    [
        *(f"\ufeff{BODY}", BODY.replace("\n", "\r")),
        *(BODY.replace("2 3\n", "2 3 # x\n", 1), BODY.replace(" 3\n", " \\\n3\n")),
    ],
)
def test_forms_that_pybullet_reads_wrong_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "mesh.obj"
    path.write_bytes(text.encode())
    assert read_obj(path).faces.shape == (4, 3)
    with pytest.raises(DataFormatError, match="which PyBullet does not read"):
        check_mesh(path)


def test_flat_meshes_are_no_solids(tmp_path: Path) -> None:
    flat = write(tmp_path, f"{TRIANGLE}f 1 2 3\n")
    check_mesh(flat)
    with pytest.raises(DataFormatError, match="all vertices are in one plane"):
        check_mesh(flat, solid=True)


MODEL = """<robot name="thing">
  <link name="base"/>
  <joint name="joint" type="revolute"><parent link="base"/><child link="body"/></joint>
  <link name="body">
    <inertial><mass value="0.5"/></inertial>
    <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
  </link>
</robot>
"""


@pytest.mark.parametrize("name", URDF_RANGES)
def test_numbers_are_finite_and_within_their_range(name: str, tmp_path: Path) -> None:
    path, (low, high) = tmp_path / "model.urdf", URDF_RANGES[name]
    tag, attribute = name.split() if " " in name else ("thing", name)

    def write(text: str) -> None:
        path.write_text(MODEL.replace('<link name="base"/>', f'<link name="base"><{tag} {attribute}="{text}"/></link>'))

    write(f"{low} {high}")
    parse_urdf(path)
    out = (f"{high * 1.01}", f"{low - 0.01 * abs(low) - 1e-9}", "nan", "inf", "", "1_0", "٣", "1 nan 1")
    for text in out:
        write(text)
        with pytest.raises(SimulationError, match=rf"{attribute} of <{tag}> must be a number from .* to .*, got"):
            read_tree(path)


def test_official_files_pass() -> None:
    folders = [Path(handover_marl.assets.__file__).parent]
    folders += [
        Path(os.environ[name]) for name in ("HANDOVER_MARL_DATA", "HANDOVER_MARL_SEVERAL_OBJECTS") if name in os.environ
    ]
    files = [path for folder in folders for path in folder.rglob("*.urdf") if path.parent.name != "templates"]
    assert len(files) > 10
    for path in files:
        parse_urdf(path)


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


@pytest.mark.parametrize("n", [4, 8, 60, 400])
def test_hulls_contain_all_points_and_hardly_shrink(n: int) -> None:
    points = np.random.default_rng(n).normal(size=(n, 3))
    kept = select_extreme_points(points, 64)
    assert len(kept) <= 64
    assert {tuple(point) for point in kept} <= {tuple(point) for point in points}
    assert (np.ptp(kept, axis=0) > 0.9 * np.ptp(points, axis=0)).all()
    corners, faces = compute_convex_hull(points)
    first, second, third = (corners[faces[:, corner]] for corner in range(3))
    heights = np.einsum("fi,fni->fn", np.cross(second - first, third - first), points[None] - first[:, None])
    assert heights.max() < 1e-9, "nothing lies outside of any face"
    # In a closed surface, every edge occurs once in each direction.
    edges = [(a, b) for face in faces.tolist() for a, b in zip(face, [*face[1:], face[0]], strict=True)]
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
