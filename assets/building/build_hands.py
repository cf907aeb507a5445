"""Writes the shipped hand models: `python -m handover_marl.assets.building.build_hands [--out DIR]`.

The meshes are made once, for the reference hand, and every person's URDF scales them; a left hand has mirrored
meshes of its own. A rebuild gives the same bytes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import tyro
from rich.progress import track

from handover_marl.assets.anthropometry import SKIN_COLOURS
from handover_marl.assets.building.hand_meshes import MESH_NAMES, collision_mesh, visual_mesh
from handover_marl.assets.hand_model import HANDS_FOLDER, SIDES, SUBJECTS, HandModel, Side, hand_model, hand_name

_PALM_MASS, _PHALANX_MASS = 0.2, 0.02
_AXES = ("1 0 0", "0 1 0", "0 0 1")
_FINGER_LIMITS = (np.pi, np.pi / 2, np.pi)


@dataclass(frozen=True)
class Args:
    """Build the procedural hands.

    Attributes:
        out: Folder to write to.
    """

    out: Path = HANDS_FOLDER


def obj_text(mesh: trimesh.Trimesh, mirror: bool) -> str:
    """A mesh as Wavefront OBJ, coordinates in micrometre steps; mirrored in x if asked for."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if mirror:
        vertices[:, 0] *= -1.0
        faces = faces[:, ::-1]
    lines = ["v " + " ".join(_number(value) for value in vertex) for vertex in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(lines) + "\n"


def urdf_text(model: HandModel, name: str, colour: tuple[float, float, float]) -> str:
    """The URDF of one hand, with HandoverSim's 53 links."""
    folder = f"../meshes/{model.side}"
    scale = " ".join(_number(value) for value in model.scale)
    rgba = " ".join(_number(value) for value in (*colour, 1.0))
    lines = ['<?xml version="1.0"?>', f'<robot name="{name}">']
    lines += [f'  <material name="skin"><color rgba="{rgba}"/></material>', _link(0)]
    for joint in range(1, 53):
        axis = (joint - 1) % 3 if joint < 7 else (joint - 8) % 3
        finger, parent, origin = (joint - 8) // 3, joint - 1, np.zeros(3)
        if joint == 7:
            origin = model.palm_offset
        elif joint > 7 and axis == 0:
            # A digit's root hangs on the palm, the others on the joint before.
            parent, origin = (7 if finger % 3 == 0 else joint - 1), model.joint_origins[finger]
        solid = None
        if joint == 7:
            solid = (f"{folder}/{{}}/{MESH_NAMES[0]}.obj", scale, _PALM_MASS)
        elif joint > 7 and axis == 2:
            solid = (f"{folder}/{{}}/{MESH_NAMES[finger + 1]}.obj", scale, _PHALANX_MASS)
        lines.append(_link(joint, solid))
        lines.append(_joint(joint, parent, axis, " ".join(_number(value) for value in origin)))
    return "\n".join([*lines, "</robot>", ""])


def _link(number: int, solid: tuple[str, str, float] | None = None) -> str:
    mesh, scale, mass = solid or ("", "", 0.0)
    inertia = 1 if solid else 0
    parts = [
        f'  <link name="link{number}">',
        f'    <inertial><origin xyz="0 0 0" rpy="0 0 0"/><mass value="{_number(mass)}"/>',
        f'      <inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial>',
    ]
    if solid:
        for kind, skin in (("visual", '<material name="skin"/>'), ("collision", "")):
            shape = f'<geometry><mesh filename="{mesh.format(kind)}" scale="{scale}"/></geometry>'
            parts.append(f'    <{kind}><origin xyz="0 0 0" rpy="0 0 0"/>{shape}{skin}</{kind}>')
    return "\n".join([*parts, "  </link>"])


def _joint(number: int, parent: int, axis: int, origin: str) -> str:
    if number == 7:
        kind, axis_text, limits = "fixed", "0 0 0", (1.0, -1.0)
    elif number < 7:
        kind = "prismatic" if number <= 3 else "continuous"
        axis_text, limits = _AXES[axis], (-1000.0, 1000.0) if number <= 3 else (1.0, -1.0)
    else:
        kind, axis_text, limits = "revolute", _AXES[axis], (-_FINGER_LIMITS[axis], _FINGER_LIMITS[axis])
    return "\n".join(
        [
            f'  <joint name="joint{number}" type="{kind}"><origin xyz="{origin}" rpy="0 0 0"/>',
            f'    <parent link="link{parent}"/><child link="link{number}"/><axis xyz="{axis_text}"/>',
            f'    <limit lower="{limits[0]!r}" upper="{limits[1]!r}" effort="1000" velocity="1000"/></joint>',
        ]
    )


def _number(value: float) -> str:
    text = f"{round(float(value), 6) + 0.0:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def write_meshes(out: Path, side: Side) -> None:
    """Write a side's 16 visual and 16 collision meshes below `out`/meshes/<side>."""
    for kind, make in (("visual", visual_mesh), ("collision", collision_mesh)):
        folder = out / "meshes" / side / kind
        folder.mkdir(parents=True, exist_ok=True)
        for number, name in enumerate(MESH_NAMES):
            (folder / f"{name}.obj").write_text(obj_text(make(number), mirror=side == "left"))


def write_urdf(out: Path, subject: int, side: Side) -> Path:
    """Write one hand's URDF below `out` and return its path."""
    name = hand_name(subject, side)
    path = out / name / "mano.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(urdf_text(hand_model(subject, side), name, SKIN_COLOURS[subject - 1]))
    return path


def main(args: Args) -> None:
    """Write all meshes and the twenty URDFs."""
    for side in SIDES:
        write_meshes(args.out, side)
        for subject in track(SUBJECTS, description=f"{side} hands"):
            write_urdf(args.out, subject, side)


if __name__ == "__main__":
    main(tyro.cli(Args))
