"""Distances of robot and human hand in MuJoCo."""

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
from handover_marl.simulation.mujoco.models.scene_spec import HULL_MARGIN

Array = npt.NDArray[np.float64]


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
            self._models[hand_urdf] = _PairModel(self._panda_urdf, hand_urdf)
        pair = self._models[hand_urdf]
        robot_poses = _compute_link_poses(self._tree, robot, pair.robot_links, self._world_from_base)
        hand_poses = _compute_link_poses(read_tree(hand_urdf), hand, pair.hand_links, IDENTITY)
        poses = np.concatenate([robot_poses, hand_poses])
        pair.data.mocap_pos[:], pair.data.mocap_quat[:] = poses[:, :3], np.roll(poses[:, 3:], 1, axis=1)
        return pair.find_min_distance(max_distance)

    def close(self) -> None:
        """Free the MuJoCo models of all hands."""
        self._models.clear()


class _PairModel:
    """MuJoCo model of a Panda and a human hand whose links are mocap bodies; the Panda's come first.

    Attributes:
        data: MuJoCo data of the model.
        robot_links: Link number of each of the Panda's bodies; -1 is the base link.
        hand_links: Link number of each of the hand's bodies.
    """

    def __init__(self, panda_urdf: Path, hand_urdf: Path) -> None:
        spec = mujoco.MjSpec()
        self.robot_links, self.hand_links = (_add_links(spec, urdf) for urdf in (panda_urdf, hand_urdf))
        self._model = model = spec.compile()
        self.data = mujoco.MjData(model)
        # Geoms are in the order of their bodies; body 0 is the world.
        robot = model.geom_bodyid <= len(self.robot_links)
        self._pairs = np.array([(a, b) for a in np.flatnonzero(robot) for b in np.flatnonzero(~robot)])
        # Margins that Bullet's hulls have in each pair (m).
        margins = np.where(model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH), HULL_MARGIN, 0.0)
        self._margins = margins[self._pairs].sum(axis=1)

    def find_min_distance(self, max_distance: float) -> float:
        """Return the smallest distance of Panda and hand (m), at most `max_distance`."""
        mujoco.mj_kinematics(self._model, self.data)
        first, second = self._pairs.T
        between = np.linalg.norm(self.data.geom_xpos[first] - self.data.geom_xpos[second], axis=1)
        bounds = between - self._model.geom_rbound[first] - self._model.geom_rbound[second] - self._margins
        nearest = max_distance
        for number in np.argsort(bounds):
            if bounds[number] >= nearest:
                break
            margin, pair = float(self._margins[number]), self._pairs[number].tolist()
            found = mujoco.mj_geomDistance(self._model, self.data, *pair, nearest + margin, None)
            nearest = min(nearest, found - margin)
        return nearest


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
