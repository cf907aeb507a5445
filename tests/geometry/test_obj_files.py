import codecs
from pathlib import Path

import numpy as np
import pytest
import trimesh

from handover_marl.errors import DataFormatError
from handover_marl.geometry.model_files.obj_files import check_mesh, read_obj

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "mesh.obj"
    path.write_text(text)
    return path


def test_groups_polygons_and_counting_back(tmp_path: Path) -> None:
    text = f"o first\n{TRIANGLE}v 1 1 0\nf 1//1 2//1 4//1 3//1\no second\nf -4/1 -3/2 -2/3\n"
    found = read_obj(write(tmp_path, text))
    assert found.vertices.shape == (4, 3)
    assert [group.tolist() for group in found.groups] == [[[0, 1, 3], [0, 3, 2]], [[0, 1, 2]]]
    assert len(found.faces) == 3


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
        (f"{TRIANGLE}f one two three\n", "not an OBJ file"),
    ],
)
def test_damaged_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_obj(write(tmp_path, text))


BODY = f"{TRIANGLE}v 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize(
    "text",
    [
        f"\ufeff{BODY}",
        BODY.replace("2 3\n", "2 3 # x\n", 1),
        BODY.replace(" 3\n", " \\\n3\n"),
        BODY.replace("\n", "\r"),
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
