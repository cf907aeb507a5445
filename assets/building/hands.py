"""Hand models: meshes for the reference hand, and URDFs of the subjects, which scale them.

The meshes are a rounded palm and phalanges as tapered capsules. A left hand has its own mirrored meshes. Building the
models again gives the same files, byte by byte.
"""

from collections.abc import Callable
from pathlib import Path

import manifold3d
import numpy as np
import numpy.typing as npt
import trimesh
from rich.progress import track

from handover_marl.assets.building.shapes import make_hull
from handover_marl.assets.hand_model import (
    HANDS_FOLDER,
    MESH_NAMES,
    REFERENCE_SIZE,
    SIDES,
    SKIN_COLORS,
    SUBJECTS,
    FloatArray,
    Side,
    format_hand_name,
    format_hand_urdf,
    format_numbers,
    make_hand_geometry,
    scale_hand,
)
from handover_marl.datasets.generated.hands import make_forearm_capsules, make_palm_capsules
from handover_marl.geometry.model_files.meshes import select_extreme_points

#: Largest number of vertices of a collision mesh; Bullet is slow with more.
MAX_COLLISION_VERTICES = 60

_EDGE_LENGTH = 0.0038
_BLEND = 0.007

# trimesh has no types.
_align_vectors: Callable[[npt.ArrayLike, npt.ArrayLike], FloatArray] = trimesh.geometry.align_vectors


def build_hands(out: Path = HANDS_FOLDER) -> None:
    """Build the meshes of both hands and the URDFs of ten subjects' two hands.

    Args:
        out: Folder for meshes and URDFs.
    """
    for side in SIDES:
        write_meshes(out, side)
        for subject in track(SUBJECTS, description=f"{side} hands"):
            write_hand_urdf(out, subject, side)


# The meshes are made for the reference right hand.
_HAND = scale_hand(REFERENCE_SIZE, "right")


def make_visual_mesh(link: int) -> trimesh.Trimesh:
    """Return the visual mesh (m) of a hand link (0 palm, 1 to 15 phalanges) in its own frame."""
    if link == 0:
        return _make_palm_mesh()
    return _make_capsule(link, ring=18, profile=6, waist=0.94)


def make_collision_mesh(link: int) -> trimesh.Trimesh:
    """Return the convex collision mesh (m) of a hand link (0 palm, 1 to 15 phalanges)."""
    if link > 0:
        return make_hull(np.asarray(_make_capsule(link, 8, 3, 1.0).vertices))
    spheres = [
        end + radius * _make_sphere_points(7, 1)
        for start, stop, first, last in make_palm_capsules(_HAND)
        for end, radius in ((start, first), (stop, last))
    ]
    hull = make_hull(np.vstack(spheres))
    return make_hull(select_extreme_points(np.asarray(hull.vertices), MAX_COLLISION_VERTICES))


def _make_capsule(link: int, ring: int, profile: int, waist: float) -> trimesh.Trimesh:
    """Return a tapered capsule along a phalanx, with `waist` times the radius in its middle."""
    tip, (first, last) = _HAND.tips[link - 1], _HAND.radii[link - 1]
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


def _make_palm_mesh() -> trimesh.Trimesh:
    capsules = [(a, b - a, r0, r1) for a, b, r0, r1 in make_palm_capsules(_HAND) + make_forearm_capsules(_HAND)]

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


def format_obj(mesh: trimesh.Trimesh, mirror: bool) -> str:
    """Return a mesh as Wavefront OBJ text with up to 6 decimals, mirrored in x if `mirror` is set."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if mirror:
        vertices[:, 0] *= -1.0
        faces = faces[:, ::-1]
    lines = [f"v {format_numbers(vertex)}" for vertex in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    return "\n".join(lines) + "\n"


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
    model = make_hand_geometry(subject, side)
    path.write_text(format_hand_urdf(model, name, SKIN_COLORS[subject - 1], f"../meshes/{side}"))
    return path
