"""Make the procedural objects' files: `python -m handover_marl.assets.building.build_objects [--out DIR]`.

Needs the extra `assets`. The same versions of its packages give the same bytes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import trimesh
import tyro
from rich.progress import track

from handover_marl.assets.building import shapes_packages, shapes_tools, shapes_vessels
from handover_marl.assets.building.obj_writing import write_convex_parts, write_palette, write_visual
from handover_marl.assets.building.shapes import Piece
from handover_marl.assets.building.urdf_objects import chain_urdf
from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, URDF_NAME, VISUAL_NAME

_METRES = 0.001  # the shapes' tables are in millimetres

#: Class name -> the function that makes its pieces.
SHAPES: MappingProxyType[str, Callable[[], tuple[Piece, ...]]] = MappingProxyType(
    {
        "002_master_chef_can": shapes_packages.master_chef_can,
        "003_cracker_box": shapes_packages.cracker_box,
        "004_sugar_box": shapes_packages.sugar_box,
        "005_tomato_soup_can": shapes_packages.tomato_soup_can,
        "006_mustard_bottle": shapes_vessels.mustard_bottle,
        "007_tuna_fish_can": shapes_packages.tuna_fish_can,
        "008_pudding_box": shapes_packages.pudding_box,
        "009_gelatin_box": shapes_packages.gelatin_box,
        "010_potted_meat_can": shapes_packages.potted_meat_can,
        "011_banana": shapes_packages.banana,
        "019_pitcher_base": shapes_vessels.pitcher_base,
        "021_bleach_cleanser": shapes_vessels.bleach_cleanser,
        "024_bowl": shapes_vessels.bowl,
        "025_mug": shapes_vessels.mug,
        "035_power_drill": shapes_tools.power_drill,
        "036_wood_block": shapes_packages.wood_block,
        "037_scissors": shapes_tools.scissors,
        "040_large_marker": shapes_tools.large_marker,
        "051_large_clamp": shapes_tools.large_clamp,
        "052_extra_large_clamp": shapes_tools.extra_large_clamp,
        "061_foam_brick": shapes_packages.foam_brick,
    }
)


@dataclass(frozen=True)
class Args:
    """What to build.

    Attributes:
        out: Folder that gets one folder per object.
        only: Class names to build; all if empty.
    """

    out: Path = OBJECTS_ROOT
    only: tuple[str, ...] = ()


def build_object(name: str, out: Path) -> Path:
    """Write one object's URDF, meshes and palette under `out`/`name` and return that folder."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    pieces = SHAPES[name]()
    visual = [(colour, _in_metres(mesh)) for piece in pieces for colour, mesh in piece.visual]
    write_visual(folder / VISUAL_NAME, visual)
    write_convex_parts(folder / COLLISION_NAME, [_in_metres(part) for piece in pieces for part in piece.collision])
    write_palette(folder)
    (folder / URDF_NAME).write_text(chain_urdf(VISUAL_NAME, COLLISION_NAME), newline="\n")
    return folder


def _in_metres(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices * _METRES, mesh.faces, process=False)


def main(args: Args) -> None:
    """Build the chosen objects."""
    for name in track(args.only or tuple(SHAPES), description="objects"):
        build_object(name, args.out)


if __name__ == "__main__":
    main(tyro.cli(Args))
