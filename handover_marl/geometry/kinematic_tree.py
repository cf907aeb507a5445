"""Kinematic trees read from URDF files: forward kinematics of many configurations, or many models, at once.

Links are numbered from 0, depth first, as in Bullet; the base link has the number -1. Quaternions are xyzw.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import OptionError, SimulationError
from handover_marl.execution.reading import cached_by_file
from handover_marl.geometry.arrays import AnyArray, ArrayFactory, GrowableArray, get_namespace, make_constant
from handover_marl.geometry.model_files.urdf_xml import parse_urdf, read_attribute
from handover_marl.geometry.poses import IDENTITY, transform_points
from handover_marl.geometry.rotations import quaternions_from_matrices, rotate_points

Array = npt.NDArray[np.float64]

#: Joint types of URDF files that turn about an axis.
REVOLUTE = ("revolute", "continuous")


@dataclass(frozen=True, eq=False)
class BoundingSphere:
    """Sphere around the shapes of a link: `center` (3,) in the link's frame and `radius` (m)."""

    center: Array
    radius: float


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """Joint of a URDF model between a link and its parent link.

    Attributes:
        link: Name of the child link.
        parent: Number of the parent link, -1 for the base.
        kind: URDF joint type: "revolute", "continuous", "prismatic" or "fixed".
        offset: (3,) origin of the joint in the frame of the parent link (m).
        rotation: (3, 3) rotation matrix from the joint's frame to that of the parent link.
        axis: (3,) unit axis in the joint's frame.
    """

    link: str
    parent: int
    kind: str
    offset: Array
    rotation: Array
    axis: Array


class TreeConstants(NamedTuple):
    """Constants of the L joints of one tree, or of a batch (...) of trees with the same joint types.

    Attributes:
        offsets: Origins (..., L, 3) of the joints in the frames of the parent links (m).
        rotations: Rotation matrices (..., L, 3, 3) from the joints' frames to those of the parent links.
        cross: Cross-product matrices (..., L, 3, 3) of the axes of revolute joints, zeros for other joints.
        cross_squared: Squares (..., L, 3, 3) of the matrices `cross`.
        prismatic_axes: Axes (..., L, 3) of prismatic joints in the parent links' frames, zeros for other joints.
    """

    offsets: AnyArray
    rotations: AnyArray
    cross: AnyArray
    cross_squared: AnyArray
    prismatic_axes: AnyArray


class KinematicTree:
    """Kinematic tree of a URDF model with L links besides the base link, numbered depth first from 0.

    Attributes:
        joints: Joints by link number; joint i connects link i to its parent link.
        n_dof: Number of moving joints.
        moving_links: Numbers of the child links of the moving joints, in the order of the joint positions.
        constants: Constants of the joints.
        columns: Index (L,) of each link's joint in the joint positions (d,) with a zero appended; fixed joints have the
            index `n_dof`, that of the zero.
        levels: Pair of arrays for each depth of the tree, from the base's grandchildren on: the numbers of the links
            at this depth, and of their parents.
    """

    def __init__(self, joints: Sequence[TreeJoint]) -> None:
        self.joints = tuple(joints)
        is_moving = [joint.kind in (*REVOLUTE, "prismatic") for joint in joints]
        self.n_dof = sum(is_moving)
        self.moving_links: list[int] = np.flatnonzero(is_moving).tolist()
        # Fixed joints read the zero that is appended to the joint positions.
        self.columns = np.where(is_moving, np.cumsum(is_moving) - 1, self.n_dof).astype(np.int64)
        # Reshaped for models without joints.
        offsets = np.array([joint.offset for joint in joints]).reshape(-1, 3)
        rotations = np.array([joint.rotation for joint in joints]).reshape(-1, 3, 3)
        axes = np.array([joint.axis for joint in joints]).reshape(-1, 3)
        is_revolute = np.array([joint.kind in REVOLUTE for joint in joints], dtype=bool)[:, None]
        is_prismatic = np.array([joint.kind == "prismatic" for joint in joints], dtype=bool)[:, None]
        cross = np.cross(np.eye(3), (axes * is_revolute)[:, None, :])
        prismatic_axes = (rotations @ (axes * is_prismatic)[..., None])[..., 0]
        self.constants = TreeConstants(offsets, rotations, cross, cross @ cross, prismatic_axes)
        parents = np.array([joint.parent for joint in joints], dtype=np.int64)
        depths: list[int] = []
        for parent in parents.tolist():
            depths.append(0 if parent < 0 else depths[parent] + 1)
        levels = [np.flatnonzero(np.array(depths) == depth) for depth in range(1, max(depths, default=0) + 1)]
        self.levels = [(links, parents[links]) for links in levels]

    def compute_link_frames(self, dof: npt.ArrayLike) -> tuple[Array, Array]:
        """Compute base-frame origins (n, L, 3) in m and rotations (n, L, 3, 3) of links at joints (n, d) (rad, m)."""
        values = np.asarray(dof, dtype=np.float64)
        values = np.concatenate([values, np.zeros((len(values), 1))], axis=1)[:, self.columns]
        return compute_tree_frames(self.constants, self.levels, values)

    def compute_link_poses(self, dof: npt.ArrayLike, links: Sequence[int]) -> Array:
        """Compute base-frame poses (n, k, 7), quaternions xyzw, of k links by number at joints (n, d) (rad, m)."""
        origins, rotations = self.compute_link_frames(dof)
        chosen = list(links)
        return np.concatenate([origins[:, chosen], quaternions_from_matrices(rotations[:, chosen])], axis=-1)

    def get_link(self, name: str) -> int:
        """Return the number of the link with a name; raise `ValueError` if there is none."""
        return [joint.link for joint in self.joints].index(name)

    def compute_reach(self, link: int, spheres: Mapping[int, BoundingSphere]) -> float:
        """Compute an upper bound (m) on the distance from a link's origin to any point of the link or its descendants.

        `spheres` maps the number of a link to the bounding sphere of its shapes. The bound holds for all positions of
        revolute joints, and for prismatic joints at zero.
        """
        reaches: dict[int, float] = {}
        # Children follow their parents.
        for start in range(len(self.joints) - 1, link - 1, -1):
            if start != link and self.joints[start].kind == "fixed":
                continue
            farthest, rigid = 0.0, [(start, np.zeros(3), np.eye(3))]
            while rigid:
                number, origin, turn = rigid.pop()
                if number in spheres:
                    sphere = spheres[number]
                    farthest = max(farthest, float(np.linalg.norm(origin + turn @ sphere.center)) + sphere.radius)
                for child in (child for child, joint in enumerate(self.joints) if joint.parent == number):
                    joint = self.joints[child]
                    place = origin + turn @ joint.offset
                    if joint.kind == "fixed":
                        rigid.append((child, place, turn @ joint.rotation))
                    else:
                        farthest = max(farthest, float(np.linalg.norm(place)) + reaches[child])
            reaches[start] = farthest
        return reaches[link]


def compute_tree_frames(
    constants: TreeConstants, levels: Sequence[tuple[AnyArray, AnyArray]], values: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Compute origins (..., L, 3) in m and rotations (..., L, 3, 3) of L links in the base link's frame.

    The positions of the links' joints are `values` (..., L) in rad or m, 0 for fixed joints. The constants broadcast to
    their batch axes; `levels` are `KinematicTree.levels`. All are NumPy arrays, or all are tensors.
    """
    xp = get_namespace(values)
    sines, cosines = xp.sin(values)[..., None, None], xp.cos(values)[..., None, None]
    identity = make_constant((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), values).reshape(3, 3)
    rotations = constants.rotations @ (identity + sines * constants.cross + (1.0 - cosines) * constants.cross_squared)
    origins = constants.offsets + values[..., None] * constants.prismatic_axes
    for links, parents in levels:
        carried = rotations[..., parents, :, :]
        origins[..., links, :] = origins[..., parents, :] + (carried @ origins[..., links, :, None])[..., 0]
        rotations[..., links, :, :] = carried @ rotations[..., links, :, :]
    return origins, rotations


@cached_by_file(maxsize=None)
def read_tree(urdf: Path) -> KinematicTree:
    """Read the kinematic tree of a URDF file, cached until the file changes; raise `SimulationError` if this fails."""
    try:
        return KinematicTree(_read_joints(parse_urdf(urdf)))
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise SimulationError(f"{urdf}: cannot read this model ({error}); check the file") from error


def _read_joints(robot: ET.Element) -> list[TreeJoint]:
    """Read all joints of a URDF model, depth first from the base link."""
    elements = robot.findall("joint")
    children: dict[str, list[ET.Element]] = {}
    for element in elements:
        children.setdefault(read_attribute(element, "parent", "link"), []).append(element)
    not_base = {read_attribute(element, "child", "link") for element in elements}
    (base,) = (link.attrib["name"] for link in robot.findall("link") if link.attrib["name"] not in not_base)
    joints: list[TreeJoint] = []
    waiting = [(element, -1) for element in reversed(children.get(base, []))]
    while waiting:
        if len(joints) == len(elements):
            raise ValueError("a link has two parents")
        element, parent = waiting.pop()
        child = read_attribute(element, "child", "link")
        joints.append(_read_joint(element, child, parent))
        waiting += [(other, len(joints) - 1) for other in reversed(children.get(child, []))]
    return joints


def _read_joint(element: ET.Element, link: str, parent: int) -> TreeJoint:
    kind = element.attrib["type"]
    if kind not in (*REVOLUTE, "prismatic", "fixed"):
        raise ValueError(f"a {kind} joint")
    axis = np.array(read_attribute(element, "axis", "xyz", "1 0 0").split(), dtype=np.float64)
    length = np.linalg.norm(axis)
    return TreeJoint(
        link=link,
        parent=parent,
        kind=kind,
        offset=np.array(read_attribute(element, "origin", "xyz", "0 0 0").split(), dtype=np.float64),
        rotation=matrix_from_rpy(read_attribute(element, "origin", "rpy", "0 0 0")),
        axis=axis / length if length > 0.0 else axis,
    )


def matrix_from_rpy(rpy: str) -> Array:
    """Convert the text of a URDF `rpy` attribute, three angles in rad, to a rotation matrix (3, 3)."""
    return np.asarray(Rotation.from_euler("xyz", np.array(rpy.split(), dtype=np.float64)).as_matrix())


def compute_link_trajectory(
    urdf: Path, dof: npt.ArrayLike, world_from_base: npt.ArrayLike = IDENTITY
) -> tuple[Array, Array]:
    """Compute world origins (n, L, 3) in m and rotations (n, L, 3, 3) of the links of a URDF model.

    Its joint positions at n times are `dof` (n, d) in rad or m; `world_from_base` (7,) is the pose of its base link.
    """
    origins, rotations = read_tree(urdf).compute_link_frames(dof)
    base = np.asarray(world_from_base, dtype=np.float64)
    return transform_points(base, origins), rotate_points(base[3:], np.eye(3)).T @ rotations


class TreeBatch:
    """Kinematic trees of several URDF models on one device; the trees have the same structure, but links of any size.

    Args:
        noun: Plural noun for the models in error messages, e.g. "hands".
        arrays: Creator of arrays on the device.
    """

    def __init__(self, noun: str, arrays: ArrayFactory) -> None:
        self._noun, self._arrays = noun, arrays
        self._numbers: dict[tuple[Path, int], int] = {}
        self._structure: list[npt.NDArray[np.int_]] = []
        self._constants: list[GrowableArray] = []
        self._levels: Sequence[tuple[AnyArray, AnyArray]] = ()

    def add(self, urdf: Path) -> int:
        """Return the number of a model, copied to the device if new; raise `OptionError` for another structure."""
        key = urdf, urdf.stat().st_mtime_ns
        if key not in self._numbers:
            self._numbers[key] = self._add(urdf)
        return self._numbers[key]

    def compute_link_frames(self, numbers: AnyArray, joints: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Compute base-frame origins (r, k, L, 3) in m and rotations (r, k, L, 3, 3) of the links of r models.

        `numbers` (r,) are the models' numbers from `add`; `joints` (r, k, d) are k configurations of each model (rad,
        m), float64.
        """
        xp = self._arrays.xp
        constants = TreeConstants(*(array.rows[numbers][:, None] for array in self._constants))
        values = xp.concat([joints, xp.zeros_like(joints[..., :1])], axis=-1)[..., self._columns]
        return compute_tree_frames(constants, self._levels, values)

    def _add(self, urdf: Path) -> int:
        tree, arrays = read_tree(urdf), self._arrays
        structure = [tree.columns, *(part for level in tree.levels for part in level)]
        if not self._constants:
            self._structure = structure
            self._constants = [GrowableArray(arrays, part.shape, "float64") for part in tree.constants]
            self._columns = arrays.asarray(tree.columns)
            self._levels = [(arrays.asarray(links), arrays.asarray(parents)) for links, parents in tree.levels]
        same = len(structure) == len(self._structure)
        if not same or not all(map(np.array_equal, structure, self._structure)):
            raise OptionError(
                f"{urdf}: all {self._noun} must have the same joints with backend='warp', this one has others; use "
                "backend='threads'"
            )
        (number,) = {array.extend(part) for array, part in zip(self._constants, tree.constants, strict=True)}
        return number
