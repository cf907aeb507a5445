"""Build the object models: `python -m handover_marl.assets.building.build_objects [--out DIR]`.

Needs the extra `assets`. The same versions of its packages give the same bytes.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import trimesh
import tyro
from rich.progress import track

from handover_marl.assets.building.object_files import write_convex_parts, write_palette, write_visual
from handover_marl.assets.building.object_shapes import OBJECT_SHAPES
from handover_marl.assets.object_models import COLLISION_NAME, OBJECTS_ROOT, URDF_NAME, VISUAL_NAME

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
_MAX_TRAVEL = 1000  # m
_AXES = ("1 0 0", "0 1 0", "0 0 1")


def format_object_urdf(visual: str, collision: str) -> str:
    """Return the URDF of an object: six base joints, then a link with the meshes.

    Args:
        visual: File name of the visual mesh.
        collision: File name of the convex parts.
    """
    robot = ET.Element("robot", name="model_normalized")
    for number in range(7):
        _add_link(robot, number, visual, collision)
        if number:
            _add_joint(robot, number)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _add_link(robot: ET.Element, number: int, visual: str, collision: str) -> None:
    link = ET.SubElement(robot, "link", name=f"link{number}")
    is_body = number == 6
    if is_body:
        ET.SubElement(ET.SubElement(link, "contact"), "lateral_friction", value=str(FRICTION))
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(MASS if is_body else 0))
    # Required by URDF; Bullet computes the inertia from the collision shape.
    moment = "1" if is_body else "0"
    ET.SubElement(inertial, "inertia", ixx=moment, ixy="0", ixz="0", iyy=moment, iyz="0", izz=moment)
    if not is_body:
        return
    for kind, file_name in (("visual", visual), ("collision", collision)):
        element = ET.SubElement(link, kind)
        ET.SubElement(ET.SubElement(element, "geometry"), "mesh", filename=file_name, scale="1 1 1")
        if kind == "visual":
            ET.SubElement(ET.SubElement(element, "material", name="palette"), "color", rgba="1 1 1 1")


def _add_joint(robot: ET.Element, number: int) -> None:
    slides = number <= 3
    joint = ET.SubElement(robot, "joint", name=f"joint{number}", type="prismatic" if slides else "continuous")
    ET.SubElement(joint, "parent", link=f"link{number - 1}")
    ET.SubElement(joint, "child", link=f"link{number}")
    ET.SubElement(joint, "axis", xyz=_AXES[(number - 1) % 3])
    if slides:
        ET.SubElement(joint, "limit", lower=str(-_MAX_TRAVEL), upper=str(_MAX_TRAVEL))


if __name__ == "__main__":
    main(tyro.cli(Args))
