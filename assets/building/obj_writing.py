"""Writing the OBJ files of the models, and the palette picture that colours them.

PyBullet draws one texture per OBJ file and ignores vertex colours, so every face points at the middle of its
colour's cell in a small picture.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

#: Colour name -> sRGB.
PALETTE = {
    "black": (38, 38, 40),
    "blue": (38, 84, 160),
    "brown": (110, 66, 36),
    "cream": (240, 225, 190),
    "navy": (28, 40, 92),
    "olive": (120, 128, 50),
    "orange": (226, 92, 28),
    "red": (184, 34, 32),
    "skin": (224, 172, 140),
    "steel": (176, 180, 184),
    "white": (240, 240, 236),
    "wood": (188, 142, 92),
    "yellow": (242, 200, 40),
}
_CELL = 4  # pixels along a cell's side, so that interpolation at its middle stays inside it


def palette_picture() -> npt.NDArray[np.uint8]:
    """The picture (_CELL, n * _CELL, 3) with one square cell for each colour, in alphabetical order."""
    colours = np.array([PALETTE[name] for name in sorted(PALETTE)], dtype=np.uint8)
    return np.repeat(np.repeat(colours[None], _CELL, axis=0), _CELL, axis=1)


def write_palette(folder: Path) -> None:
    """Write `palette.png` and the material file `palette.mtl` that names it."""
    from PIL import Image

    # Stored, not compressed: compressors differ in their bytes between versions.
    Image.fromarray(palette_picture()).save(folder / "palette.png", compress_level=0)
    (folder / "palette.mtl").write_text("newmtl palette\nKa 1 1 1\nKd 1 1 1\nmap_Kd palette.png\n", newline="\n")


def write_visual(path: Path, coloured: Iterable[tuple[str, trimesh.Trimesh]]) -> None:
    """Write meshes (m), each in one colour of the palette, as one OBJ file; needs `write_palette` beside it."""
    names = sorted(PALETTE)
    lines = ["mtllib palette.mtl", "o visual", "usemtl palette"]
    lines += [f"vt {(index + 0.5) / len(names):.4f} 0.5" for index in range(len(names))]
    first = 1
    for colour, mesh in coloured:
        texture = names.index(colour) + 1
        vertices, faces = _rounded(mesh)
        lines += _vertex_lines(vertices)
        lines += ["f " + " ".join(f"{first + corner}/{texture}" for corner in face) for face in faces]
        first += len(vertices)
    path.write_text("\n".join(lines) + "\n", newline="\n")


def write_convex_parts(path: Path, parts: Sequence[trimesh.Trimesh]) -> None:
    """Write convex meshes (m) as the objects of one OBJ file: PyBullet makes one hull of each."""
    lines = []
    first = 1
    for number, part in enumerate(parts):
        vertices, faces = _rounded(part)
        lines += [f"o convex_{number}", *_vertex_lines(vertices)]
        lines += ["f " + " ".join(str(first + corner) for corner in face) for face in faces]
        first += len(vertices)
    path.write_text("\n".join(lines) + "\n", newline="\n")


def _rounded(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Vertices to 1e-6 m and faces in an order that only depends on the shape."""
    # Adding zero turns -0.0 into 0.0.
    rounded = np.round(np.asarray(mesh.vertices, dtype=np.float64), 6) + 0.0
    vertices, renumbered = np.unique(rounded, axis=0, return_inverse=True)
    faces = renumbered.reshape(-1)[np.asarray(mesh.faces)]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[whole]
    turned = np.stack([np.roll(face, -int(np.argmin(face))) for face in faces])
    return vertices, turned[np.lexsort(turned.T[::-1])]


def _vertex_lines(vertices: npt.NDArray[np.float64]) -> list[str]:
    return [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
