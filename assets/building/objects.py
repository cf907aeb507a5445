"""Object models: OBJ files, the palette image that colors them, and URDFs.

With the same versions of the packages in the extra `assets`, the files are equal byte by byte.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from PIL import Image
from rich.progress import track

from handover_marl.assets.building.object_shapes import OBJECT_SHAPES
from handover_marl.assets.shipped import (
    COLLISION_NAME,
    OBJECTS_ROOT,
    PALETTE,
    URDF_NAME,
    VISUAL_NAME,
    format_object_urdf,
    format_visual,
)
from handover_marl.geometry.model_files.obj_files import format_convex_parts

_METRES_PER_MILLIMETRE = 0.001
_CELL = 4  # pixels; texture interpolation at the center stays inside of the cell


def build_objects(out: Path = OBJECTS_ROOT) -> None:
    """Build the models of all objects.

    Args:
        out: Folder for one subfolder per object.
    """
    for name in track(tuple(OBJECT_SHAPES), description="objects"):
        build_object(name, out)


def build_object(name: str, out: Path) -> Path:
    """Write the URDF, meshes and palette of an object to `<out>/<name>/` and return that folder."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    pieces = OBJECT_SHAPES[name]()
    visual = [(color, _convert_to_metres(mesh)) for piece in pieces for color, mesh in piece.visual]
    write_visual(folder / VISUAL_NAME, visual)
    write_convex_parts(
        folder / COLLISION_NAME, [_convert_to_metres(part) for piece in pieces for part in piece.collision]
    )
    colors = np.array([PALETTE[color] for color in sorted(PALETTE)], dtype=np.uint8)
    # Not compressed: compressors of other versions write other bytes.
    image = np.repeat(np.repeat(colors[None], _CELL, axis=0), _CELL, axis=1)
    Image.fromarray(image).save(folder / "palette.png", compress_level=0)
    (folder / "palette.mtl").write_text("newmtl palette\nKa 1 1 1\nKd 1 1 1\nmap_Kd palette.png\n", newline="\n")
    (folder / URDF_NAME).write_text(format_object_urdf(), newline="\n")
    return folder


def _convert_to_metres(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices * _METRES_PER_MILLIMETRE, mesh.faces, process=False)


def write_visual(path: Path, colored_meshes: Iterable[tuple[str, trimesh.Trimesh]]) -> None:
    """Write colored meshes (m) as one OBJ file next to the palette."""
    path.write_text(format_visual((color, *_canonicalize(mesh)) for color, mesh in colored_meshes), newline="\n")


def write_convex_parts(path: Path, parts: Sequence[trimesh.Trimesh]) -> None:
    """Write convex meshes (m) as the objects of one OBJ file."""
    path.write_text(format_convex_parts(map(_canonicalize, parts)), newline="\n")


def _canonicalize(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return rounded vertices and faces in an order that depends only on the shape."""
    # Adding zero turns -0.0 into 0.0.
    rounded = np.round(np.asarray(mesh.vertices, dtype=np.float64), 6) + 0.0
    vertices, renumbered = np.unique(rounded, axis=0, return_inverse=True)
    faces = renumbered.reshape(-1)[np.asarray(mesh.faces)]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[whole]
    turned = np.stack([np.roll(face, -int(np.argmin(face))) for face in faces])
    return vertices, turned[np.lexsort(turned.T[::-1])]
