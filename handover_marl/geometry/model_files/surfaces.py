"""Colors of visual meshes, as PyBullet draws them.

A shape has the color of its URDF material, multiplied with the first texture in the materials of its OBJ file; all
other values of these materials are ignored. If a URDF material is defined twice, the last one holds for all shapes.
"""

import functools
import io
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from handover_marl.execution.reading import read_plain_file, report_damage
from handover_marl.geometry.kinematic_tree import KinematicTree
from handover_marl.geometry.model_files.meshes import group_visual_shapes, read_shape_mesh
from handover_marl.geometry.model_files.obj_files import split_obj_lines, split_polygons
from handover_marl.geometry.model_files.urdf import UrdfShape

Array = npt.NDArray[np.float32]
Texture = npt.NDArray[np.uint8]

_MAX_MATERIAL_BYTES, _MAX_TEXTURE_BYTES = 10_000_000, 100_000_000
_WHITE = np.full((1, 1, 3), 255, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Surface:
    """Colors of the triangles of one `VisualMesh`, in the same order.

    Attributes:
        corners: (f, 3, 2) float32 texture coordinates of the triangles' corners: right and up, in units of the size of
            the texture, which repeats beyond 0 to 1.
        textures: (f, 3) int32 texture of each triangle: index of its first texel in `texels`, width and height.
        texels: (t, 3) uint8 red, green and blue of all textures, each row by row from the bottom.
    """

    corners: Array
    textures: npt.NDArray[np.int32]
    texels: Texture

    def sample(self, faces: npt.NDArray[np.integer], weights: Array) -> Texture:
        """Return colors (n, 3) at points on triangles `faces` (n,) with barycentric weights (n, 2): corners 2 and 3."""
        # `take` is several times as fast as indexing of rows.
        first, width, height = self.textures.take(faces, axis=0).T
        if self._is_plain:
            return np.asarray(self.texels.take(first, axis=0))
        origin, one, other = (self._places[corner].take(faces, axis=0) for corner in range(3))
        place = origin + (weights[:, :1] * one + weights[:, 1:] * other)
        place -= np.floor(place)
        column = np.minimum((place[:, 0] * width).astype(np.int64), width - 1)
        row = np.minimum((place[:, 1] * height).astype(np.int64), height - 1)
        return np.asarray(self.texels.take(first + row * width + column, axis=0))

    @functools.cached_property
    def _places(self) -> tuple[Array, Array, Array]:
        """Texture position (f, 2) of each triangle's first corner, and vectors (f, 2) from it to the others."""
        first, *others = (np.ascontiguousarray(self.corners[:, corner]) for corner in range(3))
        return first, others[0] - first, others[1] - first

    @functools.cached_property
    def _is_plain(self) -> bool:
        """Whether every texture is a single texel."""
        return bool((self.textures[:, 1:] == 1).all())


def read_surfaces(urdf: Path, tree: KinematicTree, without: Collection[str] = ()) -> list[Surface]:
    """Read the colors of the meshes that `read_visual_meshes` returns for the same arguments, in the same order."""
    return [_read_surface(urdf, shapes) for shapes in group_visual_shapes(urdf, tree, without).values()]


def _read_surface(urdf: Path, shapes: list[UrdfShape]) -> Surface:
    corners, textures, texels, first = [], [], [], 0
    for shape in shapes:
        own, image = None, _WHITE
        if shape.mesh is not None and shape.mesh.suffix.lower() == ".obj":
            own, image = _read_obj_texture(shape.mesh)
        if own is None:
            own = np.zeros((len(read_shape_mesh(shape, urdf)[1]), 3, 2), dtype=np.float32)
        # PyBullet cuts off decimals.
        colored = (image[::-1] * np.clip(shape.color[:3], 0.0, 1.0)).astype(np.uint8).reshape(-1, 3)
        corners.append(own)
        textures.append(np.tile(np.array([first, image.shape[1], image.shape[0]], dtype=np.int32), (len(own), 1)))
        texels.append(colored)
        first += len(colored)
    return Surface(np.concatenate(corners), np.concatenate(textures), np.concatenate(texels))


def _read_obj_texture(path: Path) -> tuple[Array | None, Texture]:
    """Return texture coordinates (f, 3, 2) and texture (h, w, 3) of an OBJ file; without any, None and white."""
    with report_damage(path, "OBJ file with a texture", "check the file"):
        content = read_plain_file(path)
        lines = list(split_obj_lines(content)) if b"mtllib" in content else []
        image = _load_first_texture(path.parent, lines)
        if image is None:
            return None, _WHITE
        points: list[tuple[float, ...]] = []
        polygons, counts = list[list[str]](), list[int]()
        for words in lines:
            if words[0] == "vt":
                points.append(tuple(map(float, words[1:3])))
            elif words[0] == "f":
                polygons.append(words[1:])
                counts.append(len(points))
        # Coordinates of corners without any, as in PyBullet: in files with coordinates, and in files without.
        points.append((0.0, 0.0) if points else (0.5, 0.5))
        chosen, _ = split_polygons(polygons, 1, counts)
        chosen[chosen >= len(points)] = -1
        places = np.array(points, dtype=np.float32)
        if not np.isfinite(places).all():
            raise ValueError("a texture coordinate is not finite")
        return places[chosen], image


def _load_first_texture(folder: Path, lines: list[list[str]]) -> Texture | None:
    """Return the texture (h, w, 3) of the first object that has one in the lines of words of an OBJ file, or None."""
    textures: dict[str, str] = {}
    current, has_faces = "", False
    for words in [*lines, ["o"]]:
        if words[:1] == ["mtllib"] and (folder / words[1]).is_file():
            textures |= _read_texture_names(folder / words[1])
        elif words[:1] == ["usemtl"]:
            current = words[1]
        elif words[:1] == ["f"]:
            has_faces = True
        elif words[:1] in (["o"], ["g"]) and has_faces:
            # The last material of an object is that of the whole object.
            if current in textures and (folder / textures[current]).is_file():
                image = Image.open(io.BytesIO(read_plain_file(folder / textures[current], _MAX_TEXTURE_BYTES)))
                return np.asarray(image.convert("RGB"))
            has_faces = False
    return None


def _read_texture_names(path: Path) -> dict[str, str]:
    """Return the file names of the textures in a material file, by material name."""
    names, material = {}, ""
    for words in map(str.split, read_plain_file(path, _MAX_MATERIAL_BYTES).decode(errors="replace").splitlines()):
        if words[:1] == ["newmtl"]:
            material = words[1]
        elif words[:1] == ["map_Kd"]:
            names[material] = " ".join(words[1:])
    return names
