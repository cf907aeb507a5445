"""Distances of collision shapes in MuJoCo: robot to human hand, and between robot links."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig
from handover_marl.geometry.kinematic_tree import BoundingSphere, KinematicTree, read_tree
from handover_marl.geometry.poses import IDENTITY, compose, poses_from_rotations
from handover_marl.simulation.clearance import DistanceQuery
from handover_marl.simulation.mujoco.models.collision_shapes import (
    add_collision_geom,
    compute_bounding_spheres,
    load_link_parts,
)
from handover_marl.simulation.mujoco.models.scene_spec import TUNING

Array = npt.NDArray[np.float64]

# Smallest gap (m) of links that count as never colliding, with joints beyond their soft limits by
# so much (rad, m).
_MIN_GAP, _LIMIT_OVERSHOOT = 0.01, 0.05
# Largest number of joints between two links, and of poses to try, before the links count as
# colliding.
_MAX_JOINTS, _MAX_POSES = 2, 2000


class MujocoDistanceQuery(DistanceQuery):
    """Distance query between Panda and human hand by MuJoCo, with one model for each hand.

    Args:
        panda_urdf: Model of the robot.
        config: Base pose of the robot.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig) -> None:
        self._panda_urdf, self._tree = panda_urdf, read_tree(panda_urdf)
        self._world_from_base = np.array([*config.base_position, *config.base_orientation])
        self._models: dict[Path, _PairModel] = {}

    def read_bounding_spheres(self, urdf: Path) -> dict[int, BoundingSphere]:
        """Return a sphere around the collision shapes of each link; key -1 is the base link."""
        return compute_bounding_spheres(urdf, read_tree(urdf))

    def measure(self, hand_urdf: Path, robot: list[float], hand: list[float], max_distance: float) -> float:
        """Measure the smallest distance between robot and hand (m); see `DistanceQuery.measure`."""
        if hand_urdf not in self._models:
            self._models[hand_urdf] = _compile_pair(self._panda_urdf, hand_urdf)
        pair = self._models[hand_urdf]
        robot_poses = _compute_link_poses(self._tree, robot, pair.robot_links, self._world_from_base)
        hand_poses = _compute_link_poses(read_tree(hand_urdf), hand, pair.hand_links, IDENTITY)
        poses = np.concatenate([robot_poses, hand_poses])
        pair.data.mocap_pos[:], pair.data.mocap_quat[:] = poses[:, :3], np.roll(poses[:, 3:], 1, axis=1)
        mujoco.mj_kinematics(pair.model, pair.data)
        return pair.find_min_distance(max_distance)

    def close(self) -> None:
        """Free the MuJoCo models of all hands."""
        self._models.clear()


@dataclass(frozen=True, eq=False)
class _PairModel:
    """MuJoCo model of a Panda and a human hand whose links are mocap bodies.

    Attributes:
        model: Compiled model; the Panda's bodies come first.
        data: MuJoCo data of the model.
        robot_links: Link number of each of the Panda's bodies; -1 is the base link.
        hand_links: Link number of each of the hand's bodies.
        pairs: All pairs (n, 2) of a geom of the Panda and a geom of the hand.
        margins: Sum (n,) of the margins that Bullet's hulls have in each pair (m).
    """

    model: "mujoco.MjModel"
    data: "mujoco.MjData"
    robot_links: list[int]
    hand_links: list[int]
    pairs: npt.NDArray[np.int_]
    margins: Array

    def find_min_distance(self, max_distance: float) -> float:
        """Return the smallest distance of Panda and hand (m), at most `max_distance`."""
        first, second = self.pairs.T
        between = np.linalg.norm(self.data.geom_xpos[first] - self.data.geom_xpos[second], axis=1)
        bounds = between - self.model.geom_rbound[first] - self.model.geom_rbound[second] - self.margins
        nearest = max_distance
        for number in np.argsort(bounds):
            if bounds[number] >= nearest:
                break
            margin, pair = float(self.margins[number]), self.pairs[number].tolist()
            found = mujoco.mj_geomDistance(self.model, self.data, *pair, nearest + margin, None)
            nearest = min(nearest, found - margin)
        return nearest


def _compile_pair(panda_urdf: Path, hand_urdf: Path) -> _PairModel:
    spec = mujoco.MjSpec()
    robot_links, hand_links = (_add_links(spec, urdf) for urdf in (panda_urdf, hand_urdf))
    model = spec.compile()
    # Geoms are in the order of their bodies; body 0 is the world.
    robot = model.geom_bodyid <= len(robot_links)
    pairs = np.array([(a, b) for a in np.flatnonzero(robot) for b in np.flatnonzero(~robot)])
    margins = np.where(model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH), TUNING.margin, 0.0)
    return _PairModel(model, mujoco.MjData(model), robot_links, hand_links, pairs, margins[pairs].sum(axis=1))


def _add_links(spec: "mujoco.MjSpec", urdf: Path) -> list[int]:
    """Add a mocap body for every link that has collision shapes, and return the link numbers."""
    parts_by_link = load_link_parts(urdf, read_tree(urdf))
    for parts in parts_by_link.values():
        body = spec.worldbody.add_body(mocap=True)
        for part in parts:
            add_collision_geom(spec, body, part)
    return list(parts_by_link)


def _compute_link_poses(tree: KinematicTree, joints: list[float], links: list[int], world_from_base: Array) -> Array:
    """Return the world poses (k, 7) of k links at given joint positions."""
    origins, rotations = (found[0] for found in tree.compute_link_frames(np.array([joints])))
    # Index -1, the base, selects the last frame.
    frames = np.concatenate([poses_from_rotations(origins, rotations), IDENTITY[None]])
    return np.asarray(compose(world_from_base, frames[links]))


def find_never_colliding_pairs(model: "mujoco.MjModel") -> list[tuple[int, int]]:
    """Find the pairs of robot bodies that cannot collide in any pose within the joint limits.

    This is a proof by interval subdivision, not a sample. If two bodies are farther apart in the
    middle of a box of joint angles than their points can move inside the box, they touch nowhere in
    the box; else the box is halved.

    Args:
        model: Model of the robot alone.

    Returns:
        Pairs of body numbers.
    """
    data = mujoco.MjData(model)
    solid = [body for body in range(1, model.nbody) if model.body_geomnum[body]]
    return [pair for pair in itertools.combinations(solid, 2) if _LinkPair(model, data, *pair).never_collides()]


class _LinkPair:
    """Two bodies of a robot, and the joints between them that change their relative pose."""

    def __init__(self, model: "mujoco.MjModel", data: "mujoco.MjData", first: int, second: int) -> None:
        self._model, self._data = model, data
        chains = [_list_ancestors(model, body) for body in (first, second)]
        shared = set(chains[0]) & set(chains[1])
        levers: dict[int, float] = {}
        for chain in chains:
            levers.update(_compute_levers(model, [body for body in chain if body not in shared]))
        self._joints, self._levers = list(levers), np.array(list(levers.values()))
        self._geoms = list(itertools.product(_list_geoms(model, first), _list_geoms(model, second)))

    def never_collides(self) -> bool:
        model = self._model
        if not 0 < len(self._joints) <= _MAX_JOINTS or not model.jnt_limited[self._joints].all():
            return False
        low, high = model.jnt_range[self._joints].T
        boxes = [(low - _LIMIT_OVERSHOOT, high + _LIMIT_OVERSHOOT)]
        for _ in range(_MAX_POSES):
            if not boxes:
                return True
            low, high = boxes.pop()
            middle, motion = (low + high) / 2.0, (high - low) / 2.0 * self._levers
            gap = self._measure_gap(middle) - _MIN_GAP
            if gap <= 0.0:
                return False
            if gap <= motion.sum():
                axis = int(np.argmax(motion))
                is_cut = np.eye(len(middle), dtype=bool)[axis]
                boxes += [(low, np.where(is_cut, middle, high)), (np.where(is_cut, middle, low), high)]
        return False

    def _measure_gap(self, angles: Array) -> float:
        """Return the distance of the two bodies (m) at given joint positions."""
        self._data.qpos[self._model.jnt_qposadr[self._joints]] = angles
        mujoco.mj_kinematics(self._model, self._data)
        return float(min(mujoco.mj_geomDistance(self._model, self._data, *pair, 1.0, None) for pair in self._geoms))


def _list_ancestors(model: "mujoco.MjModel", body: int) -> list[int]:
    """Return a body number and those of its ancestors up to the world body."""
    return [body] if body == 0 else [body, *_list_ancestors(model, int(model.body_parentid[body]))]


def _compute_levers(model: "mujoco.MjModel", chain: Sequence[int]) -> dict[int, float]:
    """Return upper bounds on the motion of a body's points per joint motion (m per rad or m).

    The body is the first of a kinematic chain.
    """
    levers: dict[int, float] = {}
    reach = (
        max((_compute_geom_reach(model, geom) for geom in _list_geoms(model, chain[0])), default=0.0) if chain else 0.0
    )
    for body in chain:
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            levers[int(joint)] = 1.0 if slides else reach + float(np.linalg.norm(model.jnt_pos[joint]))
            # Joints farther up rotate the body while this joint is extended.
            reach += float(np.abs(model.jnt_range[joint]).max()) + _LIMIT_OVERSHOOT if slides else 0.0
        reach += float(np.linalg.norm(model.body_pos[body]))
    return levers


def _compute_geom_reach(model: "mujoco.MjModel", geom: int) -> float:
    """Return the largest distance of a geom's points from its body's origin (m)."""
    return float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom])


def _list_geoms(model: "mujoco.MjModel", body: int) -> range:
    return range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
