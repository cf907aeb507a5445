"""Tests of the visual meshes of URDF models, and of their colors."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataFormatError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.meshes import VisualMesh, read_visual_meshes
from handover_marl.geometry.model_files.surfaces import read_surfaces
from handover_marl.simulation.bullet.client import connect, load_urdf

ASSETS = open_dataset("synthetic", robot="panda_camera").load_scene(9).assets
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def read(urdf: Path, *without: str) -> list[VisualMesh]:
    return read_visual_meshes(urdf, read_tree(urdf), without)


def write(folder: Path, *visuals: str) -> Path:
    """Write a URDF model of one link with visual shapes; return its path."""
    path = folder / "model.urdf"
    path.write_text(f'<robot name="r"><link name="l">{"".join(visuals)}</link></robot>')
    return path


def visual(shape: str, xyz: str = "0 0 0", rpy: str = "0 0 0", color: str = "") -> str:
    material = f'<material name="m{color}"><color rgba="{color} 1"/></material>' if color else ""
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry>{material}</visual>'


def read_colors(urdf: Path) -> npt.NDArray[np.uint8]:
    """Return the colors of the centers of all triangles of a model with one visible link."""
    ((surface,), (mesh,)) = read_surfaces(urdf, read_tree(urdf)), read(urdf)
    return surface.sample(np.arange(len(mesh.faces)), np.full((len(mesh.faces), 2), 1 / 3, dtype=np.float32))


def volume(mesh: VisualMesh) -> float:
    """Return the volume (m^3), which is positive if faces are counterclockwise as seen from outside."""
    return float(np.linalg.det(mesh.vertices[mesh.faces].astype(np.float64)).sum() / 6.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "urdf", [ASSETS.table, ASSETS.panda, ASSETS.hand, ASSETS.objects[0]], ids=lambda path: path.stem
)
def test_every_visible_link_has_one_mesh(urdf: Path) -> None:
    """The links with a mesh are those with a visual shape in Bullet, and faces point outwards."""
    meshes, client = read(urdf), connect()
    body = load_urdf(client, urdf)
    for mesh in meshes:
        assert (mesh.vertices.dtype, mesh.faces.dtype) == (np.float32, np.int32)
        assert volume(mesh) > 0.0
    assert len({mesh.link for mesh in meshes}) == len(meshes)
    assert {mesh.link for mesh in meshes} == {shape[1] for shape in client.getVisualShapeData(body)}


def test_shapes_of_one_link_become_one_mesh(tmp_path: Path) -> None:
    """Shapes of one link are merged into one mesh and keep their positions, corners and colors."""
    box = '<box size="1 1 1"/>'
    shapes = [visual(box, "3 0 0", color="1 0 0"), visual(box, "-3 0 0", color="0 0.5 1"), visual(box, "0 9 0")]
    (mesh,) = read(urdf := write(tmp_path, *shapes))
    assert (mesh.link, len(mesh.vertices), len(mesh.faces)) == (-1, 24, 36)
    middles = np.rint(mesh.vertices[mesh.faces].mean(axis=1) / 3.0).astype(int)
    np.testing.assert_array_equal(middles[:, :2], np.repeat([[1, 0], [-1, 0], [0, 3]], 12, axis=0))
    expected = np.repeat([[255, 0, 0], [0, 127, 255], [255, 255, 255]], 12, axis=0)
    np.testing.assert_array_equal(read_colors(urdf), expected)
    assert volume(mesh) == pytest.approx(3.0, rel=1e-6)


def test_shapes_are_where_their_origin_puts_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shift, angles, scale = rng.uniform(-1, 1, 3), rng.uniform(-np.pi, np.pi, 3), rng.uniform(0.1, 3.0, 3)
    (tmp_path / "mesh.obj").write_text(TETRAHEDRON)
    texts = [" ".join(map(repr, values.tolist())) for values in (scale, shift, angles)]
    (mesh,) = read(write(tmp_path, visual(f'<mesh filename="mesh.obj" scale="{texts[0]}"/>', *texts[1:])))
    corners = np.vstack([np.zeros(3), np.diag(scale)])
    # URDF rotates about fixed axes.
    np.testing.assert_allclose(mesh.vertices, Rotation.from_euler("xyz", angles).apply(corners) + shift, atol=1e-6)
    assert mesh.faces.tolist() == [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


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
    with pytest.raises(DataFormatError, match=r"mesh\.obj: not a readable OBJ file with a texture"):
        read_surfaces(urdf, read_tree(urdf))
