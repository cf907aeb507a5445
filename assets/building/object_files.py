"""OBJ files of objects, and the palette image that colors them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from handover_marl.assets.object_models import PALETTE, format_visual
from handover_marl.geometry.model_files.obj_files import format_convex_parts

_CELL = 4  # pixels; texture interpolation at the center stays inside of the cell


def make_palette_image() -> npt.NDArray[np.uint8]:
    """Return the image (4, 4 * n, 3) with one square cell per color, in alphabetical order."""
    colors = np.array([PALETTE[name] for name in sorted(PALETTE)], dtype=np.uint8)
    return np.repeat(np.repeat(colors[None], _CELL, axis=0), _CELL, axis=1)


def write_palette(folder: Path) -> None:
    """Write `palette.png` and the material file `palette.mtl` to a folder."""
    from PIL import Image

    # Not compressed: compressors of other versions write other bytes.
    Image.fromarray(make_palette_image()).save(folder / "palette.png", compress_level=0)
    (folder / "palette.mtl").write_text("newmtl palette\nKa 1 1 1\nKd 1 1 1\nmap_Kd palette.png\n", newline="\n")


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
