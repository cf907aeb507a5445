"""Build the hand models: `python -m handover_marl.assets.building.build_hands [--out DIR]`.

The meshes are made for the reference hand, a rounded palm and phalanges as tapered capsules; every
subject's URDF scales them. A left hand has its own mirrored meshes. Building the models again gives
the same files, byte by byte.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import manifold3d
import numpy as np
import numpy.typing as npt
import trimesh
import tyro
from rich.progress import track

from handover_marl.assets.anthropometry import REFERENCE_SIZE, SKIN_COLORS
from handover_marl.assets.building.shapes import make_hull
from handover_marl.assets.hand_model import (
    DIGIT_ORDER,
    HANDS_FOLDER,
    SIDES,
    SUBJECTS,
    FloatArray,
    HandGeometry,
    Side,
    format_hand_name,
    make_hand_geometry,
    scale_hand,
)
from handover_marl.geometry.meshes import select_extreme_points
from handover_marl.geometry.urdf import render_urdf

_PALM_MASS, _PHALANX_MASS = 0.2, 0.02
_FINGER_LIMITS = (np.pi, np.pi / 2, np.pi)

#: Tapered capsule (m): start (3,), end (3,), radius at the start, radius at the end.
Capsule = tuple[FloatArray, FloatArray, float, float]


def make_palm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return the capsules of a palm: metacarpals and balls of thumb and little finger."""
    index, middle, little, ring, thumb = _unscale_points(hand, hand.joint_origins[::3])
    drop, wrist = np.array([0.0, -0.004, 0.0]), 0.0155
    capsules = [
        (np.array([-0.012, -0.002, 0.013]), index + drop, wrist, 0.0128),
        (np.array([-0.012, -0.002, 0.005]), middle + drop, wrist, 0.0130),
        (np.array([-0.012, -0.002, -0.005]), ring + drop, wrist, 0.0125),
        (np.array([-0.012, -0.003, -0.012]), little + drop / 2, wrist, 0.0118),
        (thumb + np.array([0.004, 0.0, -0.006]), thumb + np.array([-0.024, -0.006, 0.004]), 0.0150, 0.0125),
        (np.array([-0.022, -0.008, -0.019]), little + np.array([0.022, -0.006, 0.002]), 0.0135, 0.0115),
    ]
    return _scale_capsules(hand, capsules)


def make_forearm_capsules(hand: HandGeometry) -> list[Capsule]:
    """Return the capsules of the end of the forearm in the palm's frame."""
    return _scale_capsules(
        hand,
        [(np.array([0.075, 0.0, z]), np.array([0.0, 0.0, z * 8.0 / 9.0]), 0.024, 0.0165) for z in (0.009, -0.009)],
    )


def spheres_from_capsules(capsules: list[Capsule], count: int) -> tuple[FloatArray, FloatArray]:
    """Return centers (len(capsules) * count, 3) and radii of spheres spaced evenly in capsules."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    centers = [start + t * (end - start) for start, end, _, _ in capsules]
    radii = [first + t[:, 0] * (last - first) for _, _, first, last in capsules]
    return np.vstack(centers), np.concatenate(radii)


def _compute_scale(hand: HandGeometry) -> FloatArray:
    return np.asarray(hand.scale * np.array([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0]))


def _unscale_points(hand: HandGeometry, points: FloatArray) -> FloatArray:
    return np.asarray(points / _compute_scale(hand))


def _scale_capsules(hand: HandGeometry, capsules: list[Capsule]) -> list[Capsule]:
    stretch, across = _compute_scale(hand), float(hand.scale[1])
    return [(a * stretch, b * stretch, r0 * across, r1 * across) for a, b, r0, r1 in capsules]


#: Largest number of vertices of a collision mesh; Bullet is slow with more.
MAX_COLLISION_VERTICES = 60

#: Names of the links with meshes: palm, then phalanges.
MESH_NAMES = ("palm", *(f"{digit}{joint}" for digit in DIGIT_ORDER for joint in (1, 2, 3)))

_EDGE_LENGTH = 0.0038
_BLEND = 0.007

# trimesh has no types.
_align_vectors: Callable[[npt.ArrayLike, npt.ArrayLike], FloatArray] = trimesh.geometry.align_vectors


def make_reference_hand() -> HandGeometry:
    """Return the reference right hand, for which the meshes are made."""
    return scale_hand(REFERENCE_SIZE, "right")


def make_visual_mesh(link: int) -> trimesh.Trimesh:
    """Return the visual mesh (m) of a hand link (0 palm, 1 to 15 phalanges) in its own frame."""
    if link == 0:
        return _make_palm_mesh(make_reference_hand())
    ring, profile, waist = 18, 6, 0.94
    return _make_capsule(link, ring, profile, waist)


def make_collision_mesh(link: int) -> trimesh.Trimesh:
    """Return the convex collision mesh (m) of a hand link (0 palm, 1 to 15 phalanges)."""
    if link > 0:
        return make_hull(np.asarray(_make_capsule(link, 8, 3, 1.0).vertices))
    spheres = [
        end + radius * _make_sphere_points(7, 1)
        for start, stop, first, last in make_palm_capsules(make_reference_hand())
        for end, radius in ((start, first), (stop, last))
    ]
    hull = make_hull(np.vstack(spheres))
    return make_hull(select_extreme_points(np.asarray(hull.vertices), MAX_COLLISION_VERTICES))


def _make_capsule(link: int, ring: int, profile: int, waist: float) -> trimesh.Trimesh:
    """Return a tapered capsule along a phalanx, with `waist` times the radius in its middle."""
    hand = make_reference_hand()
    tip, (first, last) = hand.tips[link - 1], hand.radii[link - 1]
    length = float(np.linalg.norm(tip))
    # The spheres are tangent to the cone; otherwise there is a dent at the joint.
    slope = np.arcsin((first - last) / length)
    start = np.linspace(-np.pi / 2, slope, profile)
    end = np.linspace(slope, np.pi / 2, profile)
    line = [(first * np.cos(a), first * np.sin(a)) for a in start]
    if waist < 1.0 and link % 3:
        line.append((waist * (first + last) / 2, length / 2))
    line += [(last * np.cos(a), length + last * np.sin(a)) for a in end]
    line[0], line[-1] = (0.0, line[0][1]), (0.0, line[-1][1])
    mesh = trimesh.creation.revolve(np.array(line), sections=ring)
    mesh.apply_transform(_align_vectors([0.0, 0.0, 1.0], tip / length))
    return mesh


def _make_palm_mesh(hand: HandGeometry) -> trimesh.Trimesh:
    capsules = [(a, b - a, r0, r1) for a, b, r0, r1 in make_palm_capsules(hand) + make_forearm_capsules(hand)]

    def inside(x: float, y: float, z: float) -> float:
        # Smooth union: soft maximum of the depths below the capsules' surfaces.
        point, depths = np.array([x, y, z]), []
        for start, axis, first, last in capsules:
            t = min(max(float((point - start) @ axis / (axis @ axis)), 0.0), 1.0)
            offset = point - start - t * axis
            depths.append(first + t * (last - first) - float(np.sqrt(offset @ offset)))
        values = np.array(depths) / _BLEND
        top = values.max()
        blended = top + np.log(np.exp(values - top).sum()) - 0.55
        # The forearm ends in a plane.
        return float(min(_BLEND * blended, 0.075 - x))

    solid = manifold3d.Manifold.level_set(inside, [-0.125, -0.05, -0.07, 0.08, 0.04, 0.065], _EDGE_LENGTH)
    solid = solid.simplify(0.00025)
    mesh = solid.to_mesh()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))


def _make_sphere_points(around: int, rings: int) -> FloatArray:
    """Return points on a unit sphere: two poles and `2 * rings + 1` parallels."""
    polar = np.linspace(0.0, np.pi, 2 * rings + 3)[1:-1]
    turn = np.arange(around) * 2.0 * np.pi / around
    points = [[np.sin(p) * np.cos(t), np.cos(p), np.sin(p) * np.sin(t)] for p in polar for t in turn]
    return np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], *points])


@dataclass(frozen=True)
class Args:
    """Options of the builder of hand models.

    Attributes:
        out: Folder for meshes and URDFs.
    """

    out: Path = HANDS_FOLDER


def format_obj(mesh: trimesh.Trimesh, mirror: bool) -> str:
    """Return a mesh as Wavefront OBJ text with up to 6 decimals, mirrored in x if `mirror` is set."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if mirror:
        vertices[:, 0] *= -1.0
        faces = faces[:, ::-1]
    lines = [f"v {_format_numbers(vertex)}" for vertex in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(lines) + "\n"


def format_hand_urdf(model: HandGeometry, name: str, color: tuple[float, float, float]) -> str:
    """Return the URDF of a hand with HandoverSim's 53 links."""
    return render_urdf(
        __package__,
        "hand.urdf",
        name=name,
        color=_format_numbers((*color, 1.0)),
        scale=_format_numbers(model.scale),
        folder=f"../meshes/{model.side}",
        meshes=MESH_NAMES,
        positions=[_format_numbers(position) for position in (model.palm_offset, *model.joint_origins)],
        masses=(_PALM_MASS, _PHALANX_MASS),
        limits=_FINGER_LIMITS,
    )


def _format_numbers(values: Iterable[float]) -> str:
    return " ".join(_format_number(value) for value in values)


def _format_number(value: float) -> str:
    text = f"{round(float(value), 6) + 0.0:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def write_meshes(out: Path, side: Side) -> None:
    """Write the 16 visual and 16 collision meshes of a side to `meshes/<side>/`."""
    for kind, make in (("visual", make_visual_mesh), ("collision", make_collision_mesh)):
        folder = out / "meshes" / side / kind
        folder.mkdir(parents=True, exist_ok=True)
        for number, name in enumerate(MESH_NAMES):
            (folder / f"{name}.obj").write_text(format_obj(make(number), mirror=side == "left"))


def write_hand_urdf(out: Path, subject: int, side: Side) -> Path:
    """Write the URDF of a hand and return its path."""
    name = format_hand_name(subject, side)
    path = out / name / "mano.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(format_hand_urdf(make_hand_geometry(subject, side), name, SKIN_COLORS[subject - 1]))
    return path


def main(args: Args) -> None:
    """Write the meshes of both hands and the URDFs of ten subjects' two hands."""
    for side in SIDES:
        write_meshes(args.out, side)
        for subject in track(SUBJECTS, description=f"{side} hands"):
            write_hand_urdf(args.out, subject, side)


if __name__ == "__main__":
    main(tyro.cli(Args))
