import codecs
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.errors import DataFormatError, SimulationError
from handover_marl.geometry.model_files.obj_files import check_mesh, read_obj
from handover_marl.simulation.bullet.client import connect, load_urdf

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


def format_bodies(bodies: list[trimesh.Trimesh], options: dict[str, Any]) -> bytes:
    """Return the OBJ text of closed bodies in one of the many forms that the format allows."""
    lines, first = ["# bodies", "mtllib none.mtl"], 1
    for number, body in enumerate(bodies):
        lines += [f"o body {number}", f"g group{number} other", "usemtl v", "s 1"]
        lines += [f"v {x!r} {y!r} {z!r}{options['extra']}" for x, y, z in body.vertices.tolist()]
        lines += ["vn 0 0 1", "vt 0.5 0.5"]
        base = -len(body.vertices) if options["counts_back"] else first
        lines += [
            "f " + " ".join(f"{base + corner}{options['slashes']}" for corner in face) for face in body.faces.tolist()
        ]
        first += len(body.vertices)
    text = "\n".join(options["indent"] + line + options["comment"] for line in lines)
    if options["joins"]:
        text = text.replace("f ", "f \\\n")
    text = text.replace(" ", options["separator"]).replace("\n", options["line_end"])
    return (codecs.BOM_UTF8 if options["has_mark"] else b"") + text.encode()


FORMS = st.fixed_dictionaries(
    {
        "counts_back": st.booleans(),
        "slashes": st.sampled_from(["", "/1", "//1", "/1/1", "/-1/-1"]),
        "extra": st.sampled_from(["", " 1.0", " 0.1 0.2 0.3"]),
        "separator": st.sampled_from([" ", "\t", " \t  "]),
        "indent": st.sampled_from(["", "  "]),
        "comment": st.sampled_from(["", " # v 1 2 3"]),
        "line_end": st.sampled_from(["\n", "\r\n"]),
        "joins": st.booleans(),
        "has_mark": st.booleans(),
    }
)


@settings(max_examples=30, deadline=None)
@given(options=FORMS, n_bodies=st.integers(1, 3))
def test_every_form_of_the_format(options: dict[str, Any], n_bodies: int, tmp_path_factory: Any) -> None:
    """All forms have the volume, size and centre that trimesh reads from the plainest form as STL."""
    shapes = [trimesh.creation.box((1.0, 2.0, 3.0)), trimesh.creation.cylinder(0.5, 2.0, sections=7)]
    shapes.append(trimesh.creation.icosphere(subdivisions=1))
    bodies = [shape.apply_translation((4.0 * number, number, 0.0)) for number, shape in enumerate(shapes[:n_bodies])]
    path = tmp_path_factory.mktemp("obj") / "bodies.obj"
    path.write_bytes(format_bodies(bodies, options))
    found = read_obj(path)
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    stl = io.BytesIO(trimesh.util.concatenate(bodies).export(file_type="stl"))
    expected = trimesh.load(stl, file_type="stl", force="mesh")
    assert len(found.groups) == n_bodies
    assert mesh.volume == pytest.approx(expected.volume, rel=1e-5)
    np.testing.assert_allclose(mesh.extents, expected.extents, rtol=1e-5)
    np.testing.assert_allclose(mesh.center_mass, expected.center_mass, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        (TRIANGLE, "empty"),
        (f"{TRIANGLE}v nan 0 0\nf 1 2 3\n", "not finite"),
        (f"{TRIANGLE}v 0 0\nf 1 2 3\n", "three numbers"),
        (f"{TRIANGLE}v 0 0 1\nf 1 2 3\nf 2 3", "at least three corners"),
        (f"{TRIANGLE}f 1 2 4\n", "not there"),
        (f"{TRIANGLE}f 0 1 2\n", "not there"),
        (f"{TRIANGLE}f 1 2 -4\n", "not there"),
        (f"{TRIANGLE}f one two three\n", "not an OBJ file"),
    ],
)
def test_damaged_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_obj(write(tmp_path, text))


@pytest.mark.parametrize("corner", ["4", "999999999"])
def test_vertex_numbers_out_of_range_do_not_reach_pybullet(tmp_path: Path, corner: str) -> None:
    write(tmp_path, f"{TRIANGLE}f 1 2 {corner}\n")
    mesh = '<geometry><mesh filename="mesh.obj"/></geometry>'
    urdf = tmp_path / "model.urdf"
    urdf.write_text(f'<robot name="r"><link name="l"><collision>{mesh}</collision></link></robot>')
    client = connect()
    with pytest.raises(SimulationError, match=r"mesh\.obj: a face names a corner"):
        load_urdf(client, urdf)


def test_meshes_that_pybullet_reads_wrong_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, f"\ufeff{TRIANGLE}v 0 0 1\nf 1 2 3\n")
    assert len(read_obj(path).vertices) == 4
    with pytest.raises(DataFormatError, match="must not begin with a byte order mark"):
        check_mesh(path)
    flat = write(tmp_path, f"{TRIANGLE}f 1 2 3\n")
    check_mesh(flat)
    with pytest.raises(DataFormatError, match="all vertices are in one plane"):
        check_mesh(flat, solid=True)
