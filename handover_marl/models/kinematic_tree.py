"""A URDF model as Bullet sees it, without Bullet: forward kinematics of many configurations at once."""

import functools
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.errors import SimulationError
from handover_marl.models.poses import poses_from_rotations

Array = npt.NDArray[np.float64]

_TURNING = ("revolute", "continuous")
_SLIDING = ("prismatic",)
_ON_AXIS = 1e-6  # m


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball in a link's frame: `center` (3,) and `radius` (m)."""

    center: Array
    radius: float


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """The joint that carries a link.

    Attributes:
        link: Name of the link.
        parent: Number of the parent link, -1 for the base.
        kind: URDF joint type.
        offset: (3,) the joint's origin in the parent's frame (m).
        turn: (3, 3) the joint's orientation in the parent's frame.
        axis: (3,) unit axis in the joint's frame.
    """

    link: str
    parent: int
    kind: str
    offset: Array
    turn: Array
    axis: Array


class KinematicTree:
    """Links and joints, numbered as Bullet does: depth first, the base not counted.

    Attributes:
        joints: One for every link but the base.
        n_dof: Number of moving joints.
    """

    def __init__(self, joints: Sequence[TreeJoint]) -> None:
        self.joints = tuple(joints)
        moving = [joint.kind in (*_TURNING, *_SLIDING) for joint in joints]
        self.n_dof = sum(moving)
        # Links without a degree of freedom read a zero behind the last one.
        self._dof = np.where(moving, np.cumsum(moving) - 1, self.n_dof).astype(np.int64)
        # Shaped, so that a model of one link without joints is a tree too.
        self._offsets = np.array([joint.offset for joint in joints]).reshape(-1, 3)
        self._turns = np.array([joint.turn for joint in joints]).reshape(-1, 3, 3)
        axes = np.array([joint.axis for joint in joints]).reshape(-1, 3)
        turning = np.array([joint.kind in _TURNING for joint in joints], dtype=bool)[:, None]
        sliding = np.array([joint.kind in _SLIDING for joint in joints], dtype=bool)[:, None]
        self._cross = np.cross(np.eye(3), (axes * turning)[:, None, :])
        self._cross_squared = self._cross @ self._cross
        self._slides = (self._turns @ (axes * sliding)[..., None])[..., 0]
        parents = np.array([joint.parent for joint in joints], dtype=np.int64)
        depths: list[int] = []
        for parent in parents.tolist():
            depths.append(0 if parent < 0 else depths[parent] + 1)
        levels = [np.flatnonzero(np.array(depths) == depth) for depth in range(1, max(depths, default=0) + 1)]
        self._levels = [(links, parents[links]) for links in levels]

    def frames(self, dof: npt.ArrayLike) -> tuple[Array, Array]:
        """Link frames in the base link's frame.

        Args:
            dof: (n, d) joint positions (rad, m), fixed joints left out.

        Returns:
            (n, L, 3) origins (m) and (n, L, 3, 3) orientations.
        """
        values = np.asarray(dof, dtype=np.float64)
        values = np.concatenate([values, np.zeros((len(values), 1))], axis=1)[:, self._dof]
        sines, cosines = np.sin(values)[..., None, None], np.cos(values)[..., None, None]
        rotations = self._turns @ (np.eye(3) + sines * self._cross + (1.0 - cosines) * self._cross_squared)
        origins = self._offsets + values[..., None] * self._slides
        for links, parents in self._levels:
            carried = rotations[:, parents]
            origins[:, links] = origins[:, parents] + (carried @ origins[:, links, :, None])[..., 0]
            rotations[:, links] = carried @ rotations[:, links]
        return origins, rotations

    def poses(self, dof: npt.ArrayLike, links: Sequence[int]) -> Array:
        """(n, len(links), 7) poses of some links in the base link's frame, xyz (m) and quaternion xyzw."""
        origins, rotations = self.frames(dof)
        chosen = list(links)
        return poses_from_rotations(origins[:, chosen], rotations[:, chosen])

    def turning_joints(self, link: int) -> list[int]:
        """Links of the turning joints that carry a link, from the base on.

        Raises:
            ValueError: A joint on the way slides.
        """
        path: list[int] = []
        while link >= 0:
            if self.joints[link].kind in _SLIDING:
                raise ValueError(f"link {link} slides")
            if self.joints[link].kind in _TURNING:
                path.insert(0, link)
            link = self.joints[link].parent
        return path

    def range_of(self, link: int) -> tuple[Array, float]:
        """A fixed point in the base's frame (3,) and the farthest (m) that a link's origin can be from it.

        Joint limits are not respected. A point on a joint's axis does not care how that joint turns, so distances
        along runs of such joints are rigid; what is left is added up.

        Raises:
            ValueError: A joint on the way slides.
        """
        origins, rotations = (value[0] for value in self.frames(np.zeros((1, self.n_dof))))
        path = self.turning_joints(link)

        def on_axis(point: Array, joint: int) -> bool:
            axis = rotations[joint] @ self.joints[joint].axis
            return bool(np.linalg.norm(np.cross(point - origins[joint], axis)) < _ON_AXIS)

        while path and on_axis(origins[link], path[-1]):
            path.pop()
        while len(path) > 1 and on_axis(origins[path[1]], path[0]):
            path.pop(0)
        if not path:
            return origins[link], 0.0
        center = anchor = origins[path[0]]
        farthest = 0.0
        for joint in path[1:]:
            if not on_axis(anchor, joint):
                farthest += float(np.linalg.norm(origins[joint] - anchor))
                anchor = origins[joint]
        return center, farthest + float(np.linalg.norm(origins[link] - anchor))

    def reach(self, link: int, spheres: Mapping[int, Sphere]) -> float:
        """How far (m) a link's shapes and all that it carries can be from its origin, however they turn.

        Args:
            link: The link.
            spheres: A ball around the shapes of every link that has some.
        """
        return self._reach(link, np.zeros(3), np.eye(3), spheres)

    def _reach(self, link: int, origin: Array, turn: Array, spheres: Mapping[int, Sphere]) -> float:
        farthest = 0.0
        if link in spheres:
            sphere = spheres[link]
            farthest = float(np.linalg.norm(origin + turn @ sphere.center)) + sphere.radius
        for child, joint in enumerate(self.joints):
            if joint.parent != link:
                continue
            start = origin + turn @ joint.offset
            if joint.kind == "fixed":
                far = self._reach(child, start, turn @ joint.turn, spheres)
            else:
                far = float(np.linalg.norm(start)) + self.reach(child, spheres)
            farthest = max(farthest, far)
        return farthest


def read_tree(urdf: Path) -> KinematicTree:
    """Read a model file; one that has not changed is read once.

    Raises:
        SimulationError: It is no URDF, or has joints of a kind that objects, hands and Pandas do not have.
    """
    try:
        return _read(urdf, urdf.stat().st_mtime_ns)
    except OSError as error:
        raise SimulationError(f"{urdf}: cannot read this model ({error}); check the file") from error


@functools.cache
def _read(urdf: Path, changed: int) -> KinematicTree:
    try:
        robot = ET.parse(urdf).getroot()
        return KinematicTree(list(_walk(robot)))
    except (OSError, ET.ParseError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise SimulationError(f"{urdf}: cannot read this model ({error}); check the file") from error


def _walk(robot: ET.Element) -> Iterator[TreeJoint]:
    children: dict[str, list[ET.Element]] = {}
    for element in robot.findall("joint"):
        children.setdefault(attribute(element, "parent", "link"), []).append(element)
    carried = {attribute(element, "child", "link") for element in robot.findall("joint")}
    (base,) = (link.attrib["name"] for link in robot.findall("link") if link.attrib["name"] not in carried)
    yield from _descend(base, -1, children, [0])


def _descend(link: str, number: int, children: dict[str, list[ET.Element]], count: list[int]) -> Iterator[TreeJoint]:
    for element in children.get(link, []):
        child, own = attribute(element, "child", "link"), count[0]
        count[0] += 1
        yield _joint(element, child, number)
        yield from _descend(child, own, children, count)


def _joint(element: ET.Element, link: str, parent: int) -> TreeJoint:
    kind = element.attrib["type"]
    if kind not in (*_TURNING, *_SLIDING, "fixed"):
        raise ValueError(f"a {kind} joint")
    axis = np.array(attribute(element, "axis", "xyz", "1 0 0").split(), dtype=np.float64)
    length = np.linalg.norm(axis)
    return TreeJoint(
        link=link,
        parent=parent,
        kind=kind,
        offset=np.array(attribute(element, "origin", "xyz", "0 0 0").split(), dtype=np.float64),
        turn=euler_matrix(attribute(element, "origin", "rpy", "0 0 0")),
        axis=axis / length if length > 0.0 else axis,
    )


def euler_matrix(rpy: str) -> Array:
    """Rotation matrix (3, 3) of a URDF's rpy attribute (rad)."""
    matrix: Array = Rotation.from_euler("xyz", np.array(rpy.split(), dtype=np.float64)).as_matrix()
    return matrix


def attribute(element: ET.Element, tag: str, name: str, default: str | None = None) -> str:
    """An attribute of a child element, or its default.

    Raises:
        ValueError: It is not there and has no default.
    """
    found = element.find(tag)
    value = default if found is None else found.get(name, default)
    if value is None:
        raise ValueError(f"<{element.tag}> without <{tag} {name}=...>")
    return value
