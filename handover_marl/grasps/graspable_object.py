"""Contacts of the finger pads with a grasped object, and the grasps and surfaces of objects that receivers load.

Some grasps pass their validation but hold the object only by the tips or edges of the fingers. When the person releases
the object, it slips out of such a grasp within a few hundredths of a second.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.geometry.model_files.meshes import read_collision_mesh
from handover_marl.geometry.poses import inverse_transform_points
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.grasps.validation import (
    QUICK_PREPARATION,
    GraspPreparationConfig,
    ValidatedGrasps,
    has_shipped_record,
    perturb_grasps,
    validate_grasps,
)
from handover_marl.planning.robot_clearance import Spheres, compute_flange_clearances, sample_surface_spheres
from handover_marl.policies.policy import PolicyContext

Array = npt.NDArray[np.float64]

# Fingers in the hand link's frame (m): tip along z, half width along x, root along z, inner side along y when open.
_TIP_Z, _HALF_WIDTH, _ROOT_Z, _OPEN_Y = 0.1126, 0.0105, 0.058, 0.041
# Costs of a grasp that has failed its validation, and of one with a pad margin of 0 (s); pad margin from which on the
# second cost is 0 (m).
_UNSTABLE_COST, _FINGERTIP_COST, _DESIRED_PAD_MARGIN = 5.0, 4.0, 0.008
#: Cost of a grasp that does not always hold the object (s): factor on 1 minus its success rate.
PARTIAL_HOLD_COST = 2.0
# Minimum pad margin of an offset grasp (m).
_MIN_OFFSET_PAD_MARGIN = 0.004
# Number and radius (m) of the spheres that approximate the object, and number of random points on its surface.
_N_SURFACE_SPHERES, _SURFACE_RADIUS, _N_SURFACE_POINTS = 200, 0.01, 5000
# Number and radius (m) of the spheres that approximate each of the other objects.
_N_OBSTACLE_SPHERES, OBSTACLE_RADIUS = 80, 0.015
# Depth to which a soft pad touches surface points behind the first contact (m).
_PAD_SOFTNESS = 0.0015
_DEFAULT_PREPARATION = GraspPreparationConfig()


@dataclass(frozen=True, eq=False)
class GraspableObject:
    """Grasps and surface of an object in its own frame.

    Attributes:
        grasps: Validated grasps, also failed ones, at which the flange behind the hand link is clear of the object.
        pad_margins: (n,) distances of the grasps' contacts from tip and edges of the finger pads (m), see
            `compute_pad_margins`.
        surface: Spheres that coarsely approximate the object's surface.
        points: (k, 3) dense points on the object's surface (m).
        center: (3,) center of the object's bounding box (m).
    """

    grasps: ValidatedGrasps
    pad_margins: Array
    surface: Spheres
    points: Array
    center: Array


def load_graspable_object(
    context: PolicyContext, object_name: str, preparation: GraspPreparationConfig = _DEFAULT_PREPARATION
) -> GraspableObject:
    """Load the surface and the validated grasps, perhaps none, of an object class; cached.

    Grasps without a stored record are validated in simulation, which takes 20 to 90 s, or a few seconds for datasets
    with `quick_validation`.
    """
    urdf, known = context.find_object_urdf(object_name), load_hand_poses(context.load_grasps, object_name)
    if known is None:
        return _load_graspable_object(urdf, context.panda_urdf, None, preparation)
    # Options of the user are kept; what an earlier run has cached has no influence.
    is_quick = context.quick_validation and preparation == _DEFAULT_PREPARATION
    if is_quick and not has_shipped_record(urdf, context.panda_urdf, known, preparation):
        preparation = QUICK_PREPARATION
    return _load_graspable_object(urdf, context.panda_urdf, known.tobytes(), preparation)


# Environments with the same objects have different contexts.
@functools.lru_cache(maxsize=256)
def _load_graspable_object(
    urdf: Path, panda_urdf: Path, known: bytes | None, preparation: GraspPreparationConfig
) -> GraspableObject:
    grasps = ValidatedGrasps(np.zeros((0, 7)), np.zeros(0))
    if known is not None:
        grasps = validate_grasps(urdf, panda_urdf, np.frombuffer(known).reshape(-1, 7), preparation)
    vertices, faces = read_collision_mesh(urdf)
    surface = sample_surface_spheres(vertices, faces, _N_SURFACE_SPHERES, _SURFACE_RADIUS)
    points = collect_surface_points(vertices, faces, _N_SURFACE_POINTS)
    grasps = grasps.select(compute_flange_clearances(grasps.poses, surface) > 0.0)
    center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return GraspableObject(grasps, compute_pad_margins(grasps.poses, points), surface, points, center)


@functools.lru_cache(maxsize=64)
def load_obstacle(urdf: Path) -> Spheres:
    """Load spheres that coarsely approximate the surface of an object, in its own frame; cached."""
    vertices, faces = read_collision_mesh(urdf)
    return sample_surface_spheres(vertices, faces, _N_OBSTACLE_SPHERES, OBSTACLE_RADIUS)


def find_offset_grasps(
    graspable: GraspableObject, human_hand: Spheres, standoff: float
) -> tuple[ValidatedGrasps, Array]:
    """Return n offset copies of an object's grasps, clear of the person's hand, and their pad margins (n,) in m.

    Copies are tilted and shifted, see `perturb_grasps`. Those with a pad margin of at most 4 mm are left out, see
    `compute_pad_margins`. The spheres `human_hand` are in the object's frame.
    """
    offset = perturb_grasps(graspable.grasps, graspable.points, human_hand, standoff)
    margins = compute_pad_margins(offset.poses, graspable.points)
    kept = margins > _MIN_OFFSET_PAD_MARGIN
    return offset.select(kept), margins[kept]


def collect_surface_points(vertices: Array, faces: npt.NDArray[np.int_], count: int) -> Array:
    """Return the vertices (v, 3) of a mesh and `count` random points on its surface (m), always the same ones."""
    rng = np.random.default_rng(0)
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(faces), count, p=areas / areas.sum())]
    return np.concatenate([vertices, np.einsum("nk,nkc->nc", rng.dirichlet(np.ones(3), count), chosen)])


def compute_pad_margins(poses: Array, points: Array) -> Array:
    """Return the pad margins (n,) of n grasps: the distances (m) of contacts from the tip and edges of the finger pads.

    The margin of a point on a pad is its distance from the tip or twice its distance from the nearer edge (fingers are
    narrow), whichever is less. A pad has the largest margin of the points that it touches, a grasp the smaller margin
    of its two pads, or 0 if no point is between the fingers. Poses (n, 7; xyzw) of the hand link and surface points
    (k, 3) are in the object's frame.
    """
    margins = np.zeros(len(poses))
    for number, pose in enumerate(poses):
        local = inverse_transform_points(pose, points)
        x, y, z = np.abs(local[:, 0]), local[:, 1], local[:, 2]
        touched = (x < _HALF_WIDTH) & (np.abs(y) < _OPEN_Y) & (z > _ROOT_Z) & (z < _TIP_Z)
        if touched.any():
            inside = np.minimum(_TIP_Z - z[touched], 2.0 * (_HALF_WIDTH - x[touched]))
            sides = (y[touched], -y[touched])
            margins[number] = min(inside[side > side.max() - _PAD_SOFTNESS].max() for side in sides)
    return margins


def compute_hold_costs(grasps: ValidatedGrasps, pad_margins: Array, partial_cost: float = PARTIAL_HOLD_COST) -> Array:
    """Return costs (n,) in s of grasps: higher for low success rates and for small pad margins (n,) in m."""
    rates = grasps.success_rates
    costs: Array = _UNSTABLE_COST * (rates == 0.0) + partial_cost * (1.0 - rates)
    costs += _FINGERTIP_COST * np.maximum(0.0, 1.0 - pad_margins / _DESIRED_PAD_MARGIN)
    return costs
