"""Distances of a Panda's and a hand's collision shapes, measured by MuJoCo."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig
from handover_marl.models.kinematic_tree import KinematicTree, Sphere, read_tree
from handover_marl.models.poses import IDENTITY, compose, poses_from_rotations
from handover_marl.models.urdf_shapes import read_urdf_shapes
from handover_marl.sim.gap import Ruler
from handover_marl.sim.mujoco.hull_parts import convex_parts, link_balls
from handover_marl.sim.mujoco.scene_spec import add_shape
from handover_marl.sim.mujoco.tuning import TUNING

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Pair:
    """A Panda and a hand as a model of nothing but bodies that are put where they are.

    Attributes:
        model: The model; the Panda's bodies come first.
        data: Its state.
        robot_links: Links that the Panda's bodies are; -1 is the base.
        hand_links: Likewise of the hand.
        pairs: Geoms of the Panda and the hand, each with each, (n, 2).
        margins: (n,) how much nearer their surfaces are in Bullet, whose hulls have a margin (m).
    """

    model: "mujoco.MjModel"
    data: "mujoco.MjData"
    robot_links: list[int]
    hand_links: list[int]
    pairs: npt.NDArray[np.int_]
    margins: Array


class MujocoRuler(Ruler):
    """Measures in models of its own.

    Args:
        panda_urdf: The robot's model.
        config: Where it stands.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig) -> None:
        self._panda_urdf, self._tree = panda_urdf, read_tree(panda_urdf)
        self._base = np.array([*config.base_position, *config.base_orientation])
        self._pairs: dict[Path, _Pair] = {}

    def balls(self, urdf: Path) -> dict[int, Sphere]:
        """As `Ruler.balls`."""
        return link_balls(urdf, read_tree(urdf))

    def distance(self, hand_urdf: Path, robot: list[float], hand: list[float], farthest: float) -> float:
        """As `Ruler.distance`."""
        if hand_urdf not in self._pairs:
            self._pairs[hand_urdf] = _pair(self._panda_urdf, hand_urdf)
        there = self._pairs[hand_urdf]
        own = _poses(self._tree, robot, there.robot_links, self._base)
        poses = np.concatenate([own, _poses(read_tree(hand_urdf), hand, there.hand_links, IDENTITY)])
        there.data.mocap_pos[:], there.data.mocap_quat[:] = poses[:, :3], np.roll(poses[:, 3:], 1, axis=1)
        mujoco.mj_kinematics(there.model, there.data)
        return _smallest(there, farthest)

    def close(self) -> None:
        """Forget the models."""
        self._pairs.clear()


def _smallest(there: _Pair, farthest: float) -> float:
    """The smallest distance of the pairs (m)."""
    first, second = there.pairs.T
    between = np.linalg.norm(there.data.geom_xpos[first] - there.data.geom_xpos[second], axis=1)
    bounds = between - there.model.geom_rbound[first] - there.model.geom_rbound[second] - there.margins
    nearest = farthest
    for number in np.argsort(bounds):
        if bounds[number] >= nearest:
            break
        margin = float(there.margins[number])
        found = mujoco.mj_geomDistance(there.model, there.data, *there.pairs[number].tolist(), nearest + margin, None)
        nearest = min(nearest, found - margin)
    return nearest


def _pair(panda_urdf: Path, hand_urdf: Path) -> _Pair:
    spec = mujoco.MjSpec()
    robot_links, hand_links = (_add_links(spec, urdf) for urdf in (panda_urdf, hand_urdf))
    model = spec.compile()
    # Geoms lie in the order of their bodies, of which the first is the world.
    robot = model.geom_bodyid <= len(robot_links)
    pairs = np.array([(a, b) for a in np.flatnonzero(robot) for b in np.flatnonzero(~robot)])
    around = np.where(model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH), TUNING.margin, 0.0)
    return _Pair(model, mujoco.MjData(model), robot_links, hand_links, pairs, around[pairs].sum(axis=1))


def _add_links(spec: "mujoco.MjSpec", urdf: Path) -> list[int]:
    """A body for every link that has shapes; their numbers."""
    shapes = read_urdf_shapes(urdf, read_tree(urdf), "collision")
    links = sorted({shape.link for shape in shapes})
    for link in links:
        body = spec.worldbody.add_body(mocap=True)
        for part in convex_parts([shape for shape in shapes if shape.link == link]):
            add_shape(spec, body, part)
    return links


def _poses(tree: KinematicTree, joints: list[float], links: list[int], world_from_base: Array) -> Array:
    """(k, 7) world poses of links."""
    origins, rotations = (found[0] for found in tree.frames(np.array([joints])))
    frames = np.concatenate([poses_from_rotations(origins, rotations), IDENTITY[None]])
    # The base, -1, lies last.
    return compose(world_from_base, frames[links])
