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


def make_bodies(count: int) -> list[trimesh.Trimesh]:
    shapes = [trimesh.creation.box((1.0, 2.0, 3.0)), trimesh.creation.cylinder(0.5, 2.0, sections=7)]
    shapes.append(trimesh.creation.icosphere(subdivisions=1))
    return [shape.apply_translation((4.0 * number, number, 0.0)) for number, shape in enumerate(shapes[:count])]


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
    bodies = make_bodies(n_bodies)
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


def test_vertex_numbers_out_of_range_do_not_reach_pybullet(tmp_path: Path) -> None:
    write(tmp_path, f"{TRIANGLE}f 1 2 4\n")
    mesh = '<geometry><mesh filename="mesh.obj"/></geometry>'
    urdf = tmp_path / "model.urdf"
    urdf.write_text(f'<robot name="r"><link name="l"><collision>{mesh}</collision></link></robot>')
    client = connect()
    with pytest.raises(SimulationError, match=r"mesh\.obj: a face names a corner"):
        load_urdf(client, urdf)


BODY = f"{TRIANGLE}v 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"\ufeff{BODY}", "begin with a byte order mark"),
        (BODY.replace("f 1 2 3", "f 1 2 3 # bottom"), "have a comment behind a face"),
        (BODY.replace("f 1 2 3", "f 1 2 \\\n3"), "join lines with a backslash"),
        (BODY.replace("\n", "\r"), "end lines with a carriage return alone"),
    ],
)
def test_forms_that_pybullet_reads_wrong_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mesh.obj"
    path.write_bytes(text.encode())
    assert read_obj(path).faces.shape == (4, 3)
    assert read_obj(path).vertices.shape == (4, 3)
    with pytest.raises(DataFormatError, match=f"must not {message}"):
        check_mesh(path)


@settings(max_examples=20, deadline=None)
@given(options=FORMS, n_bodies=st.integers(1, 3))
def test_pybullet_reads_what_is_not_refused(options: dict[str, Any], n_bodies: int, tmp_path_factory: Any) -> None:
    """Rays hit the model in PyBullet where they hit the plainest form of its file."""
    bodies = make_bodies(n_bodies)
    plain = dict.fromkeys(options, "") | {"counts_back": False, "joins": False, "has_mark": False}
    plain |= {"separator": " ", "line_end": "\n"}
    folder, depths = tmp_path_factory.mktemp("obj"), []
    for number, chosen in enumerate((plain, options)):
        mesh = folder / f"mesh{number}.obj"
        mesh.write_bytes(format_bodies(bodies, chosen))
        try:
            check_mesh(mesh)
        except DataFormatError:
            return
        urdf = mesh.with_suffix(".urdf")
        geometry = f'<geometry><mesh filename="{mesh.name}"/></geometry>'
        urdf.write_text(f'<robot name="r"><link name="l"><collision>{geometry}</collision></link></robot>')
        client = connect()
        load_urdf(client, urdf, useFixedBase=True)
        x, y = (values.ravel() for values in np.meshgrid(np.linspace(-1.0, 9.5, 43), np.linspace(-1.5, 3.5, 23)))
        starts, ends = (np.c_[x, y, np.full(len(x), z)].tolist() for z in (5.0, -5.0))
        depths.append([hit[2] for hit in client.rayTestBatch(starts, ends)])
        client.close()
    assert min(depths[0]) < 1.0
    np.testing.assert_allclose(depths[1], depths[0], atol=1e-6)


def test_flat_meshes_are_no_solids(tmp_path: Path) -> None:
    flat = write(tmp_path, f"{TRIANGLE}f 1 2 3\n")
    check_mesh(flat)
    with pytest.raises(DataFormatError, match="all vertices are in one plane"):
        check_mesh(flat, solid=True)
