"""Build the object models: `python -m handover_marl.assets.building.build_objects [--out DIR]`.

Needs the extra `assets`. The same versions of its packages give the same bytes.
"""

from dataclasses import dataclass
from pathlib import Path

import trimesh
import tyro
from rich.progress import track

from handover_marl.assets.building.object_files import write_convex_parts, write_palette, write_visual
from handover_marl.assets.building.object_shapes import OBJECT_SHAPES
from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, URDF_NAME, VISUAL_NAME
from handover_marl.geometry.urdf import render_urdf

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
    (folder / URDF_NAME).write_text(format_object_urdf(VISUAL_NAME, COLLISION_NAME), newline="\n")
    return folder


def _convert_to_metres(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices * _METRES_PER_MILLIMETRE, mesh.faces, process=False)


def main(args: Args) -> None:
    """Build the models of the chosen objects."""
    for name in track(args.only or tuple(OBJECT_SHAPES), description="objects"):
        build_object(name, args.out)


#: Mass (kg) and lateral friction of all objects in HandoverSim.
MASS, FRICTION = 0.5, 0.9


def format_object_urdf(visual: str, collision: str) -> str:
    """Return the URDF of an object: six base joints, then a link with the meshes.

    Args:
        visual: File name of the visual mesh.
        collision: File name of the convex parts.
    """
    return render_urdf(__package__, "object.urdf", visual=visual, collision=collision, mass=MASS, friction=FRICTION)


if __name__ == "__main__":
    main(tyro.cli(Args))
