"""Tests of the visual meshes of URDF models."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataFormatError, SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import VisualMesh, read_visual_meshes
from handover_marl.geometry.model_files.surfaces import read_surfaces
from handover_marl.geometry.panda import CAMERA_LINK
from handover_marl.simulation.bullet.client import connect, load_urdf

ASSETS = open_dataset("synthetic", robot="panda_camera").load_scene(9).assets
JOINT = '<joint name="j{0}" type="fixed"><parent link="l0"/><child link="l{0}"/><origin xyz="5 5 5"/></joint>'
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def read(urdf: Path, *without: str) -> list[VisualMesh]:
    return read_visual_meshes(urdf, read_tree(urdf), without)


def write(folder: Path, *links: str) -> Path:
    """Write a URDF model whose links are all fixed to the first; return its path."""
    parts = [f'<link name="l{number}">{shapes}</link>' for number, shapes in enumerate(links)]
    joints = [JOINT.format(number) for number in range(1, len(links))]
    path = folder / "model.urdf"
    path.write_text(f'<robot name="r">{"".join(parts + joints)}</robot>')
    return path


def visual(shape: str, xyz: str = "0 0 0", rpy: str = "0 0 0", color: str = "") -> str:
    material = f'<material name="m{color}"><color rgba="{color} 1"/></material>' if color else ""
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry>{material}</visual>'


def box(x: float = 1.0, y: float = 1.0, z: float = 1.0) -> str:
    return f'<box size="{x} {y} {z}"/>'


def read_colors(urdf: Path) -> npt.NDArray[np.uint8]:
    """Return the colours of the centres of all triangles of a model with one visible link."""
    ((surface,), (mesh,)) = read_surfaces(urdf, read_tree(urdf)), read(urdf)
    assert (surface.corners.dtype, surface.textures.dtype, surface.texels.dtype) == (np.float32, np.int32, np.uint8)
    assert surface.corners.shape == (len(mesh.faces), 3, 2)
    return surface.sample(np.arange(len(mesh.faces)), np.full((len(mesh.faces), 2), 1 / 3, dtype=np.float32))


def volume(mesh: VisualMesh) -> float:
    """Return the volume (m^3), which is positive if faces are counterclockwise as seen from outside."""
    return float(np.linalg.det(mesh.vertices[mesh.faces].astype(np.float64)).sum() / 6.0)


def check_form(mesh: VisualMesh) -> None:
    assert (mesh.vertices.dtype, mesh.faces.dtype) == (np.float32, np.int32)
    assert mesh.vertices.shape[1:] == mesh.faces.shape[1:] == (3,)
    assert len(mesh.faces) > 0
    assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


@pytest.mark.parametrize("urdf", [ASSETS.table, ASSETS.panda, ASSETS.hand, *ASSETS.objects], ids=lambda path: path.stem)
def test_every_visible_link_has_one_mesh(urdf: Path) -> None:
    """The links with a mesh are those with a visual shape in Bullet, and faces point outwards."""
    meshes, client = read(urdf), connect()
    body = load_urdf(client, urdf)
    for mesh in meshes:
        check_form(mesh)
        assert volume(mesh) > 0.0
    assert len({mesh.link for mesh in meshes}) == len(meshes)
    assert {mesh.link for mesh in meshes} == {shape[1] for shape in client.getVisualShapeData(body)}


def test_links_are_left_out_by_name() -> None:
    camera = read_tree(ASSETS.panda).get_link(CAMERA_LINK)
    every, some = ([mesh.link for mesh in read(ASSETS.panda, *names)] for names in ((), (CAMERA_LINK,)))
    assert camera in every
    assert some == [link for link in every if link != camera]


def test_shapes_of_one_link_become_one_mesh(tmp_path: Path) -> None:
    """Shapes of one link are merged into one mesh and keep their positions, corners and colours."""
    shapes = [
        visual(box(), "3 0 0", color="1 0 0"),
        visual(box(0.5), "-3 0 0", color="0 0.5 1"),
        visual(box(), "0 9 0"),
    ]
    urdf = write(tmp_path, "".join(shapes))
    (mesh,) = read(urdf)
    check_form(mesh)
    assert mesh.link == -1
    assert (len(mesh.vertices), len(mesh.faces)) == (24, 36)
    middles = np.rint(mesh.vertices[mesh.faces].mean(axis=1) / 3.0).astype(int)
    np.testing.assert_array_equal(middles[:, :2], np.repeat([[1, 0], [-1, 0], [0, 3]], 12, axis=0))
    expected = np.repeat([[255, 0, 0], [0, 127, 255], [255, 255, 255]], 12, axis=0)
    np.testing.assert_array_equal(read_colors(urdf), expected)
    assert volume(mesh) == pytest.approx(2.5, rel=1e-6)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_shapes_are_where_their_origin_puts_them(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("mesh")
    shift, angles, scale = rng.uniform(-1, 1, 3), rng.uniform(-np.pi, np.pi, 3), rng.uniform(0.1, 3.0, 3)
    (folder / "mesh.obj").write_text(TETRAHEDRON)

    def words(values: npt.NDArray[np.float64]) -> str:
        return " ".join(map(repr, values.tolist()))

    shape = visual(f'<mesh filename="mesh.obj" scale="{words(scale)}"/>', words(shift), words(angles))
    (mesh,) = read(write(folder, shape))
    corners = np.vstack([np.zeros(3), np.diag(scale)])
    # URDF rotates about fixed axes.
    expected = Rotation.from_euler("xyz", angles).apply(corners) + shift
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-6)
    assert mesh.faces.tolist() == [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    assert volume(mesh) == pytest.approx(scale.prod() / 6.0, rel=1e-4)


def test_damaged_textures_are_reported(tmp_path: Path) -> None:
    """A missing texture is white, as in Bullet; one that cannot be read is an error."""
    (tmp_path / "mesh.obj").write_text(f"mtllib mesh.mtl\nusemtl m\n{TETRAHEDRON}")
    urdf = write(tmp_path, visual('<mesh filename="mesh.obj"/>'))
    assert (read_colors(urdf) == 255).all()
    (tmp_path / "mesh.mtl").write_text("newmtl m\nKd 0.1 0.2 0.3\nmap_Kd image.png\n")
    assert (read_colors(urdf) == 255).all()
    Image.new("RGB", (1, 1), (9, 8, 7)).save(tmp_path / "image.png")
    np.testing.assert_array_equal(read_colors(urdf), [[9, 8, 7]] * 4)
    (tmp_path / "image.png").write_bytes(b"nothing")
    with pytest.raises(DataFormatError, match=r"mesh\.obj: cannot read its texture"):
        read_surfaces(urdf, read_tree(urdf))


@pytest.mark.parametrize("shape", ["", '<cylinder radius="1" length="1"/>', "<mesh/>"])
def test_unreadable_shapes_are_reported(tmp_path: Path, shape: str) -> None:
    with pytest.raises(SimulationError, match=r"model\.urdf: cannot read a visual shape of link 'l1'"):
        read(write(tmp_path, visual(box()), visual(shape)))
