"""Build the object models: `python -m handover_marl.assets.building.build_objects [--out DIR]`.

The program needs the extra `assets`. With the same versions of the packages in this extra, the files are equal
byte by byte.
"""

from dataclasses import dataclass
from pathlib import Path

import trimesh
import tyro
from rich.progress import track

from handover_marl.assets.building.object_files import write_convex_parts, write_palette, write_visual
from handover_marl.assets.building.object_shapes import OBJECT_SHAPES
from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, URDF_NAME, VISUAL_NAME, format_object_urdf

_METRES_PER_MILLIMETRE = 0.001


@dataclass(frozen=True)
class Args:
    """Options of the builder of object models.

    Attributes:
        out: Folder for one subfolder per object.
        only: YCB class names to build; all if empty.
    """

    out: Path = OBJECTS_ROOT
    only: tuple[str, ...] = ()


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
    write_palette(folder)
    (folder / URDF_NAME).write_text(format_object_urdf(), newline="\n")
    return folder


def _convert_to_metres(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices * _METRES_PER_MILLIMETRE, mesh.faces, process=False)


def main(args: Args) -> None:
    """Build the models of the chosen objects."""
    for name in track(args.only or tuple(OBJECT_SHAPES), description="objects"):
        build_object(name, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args))
