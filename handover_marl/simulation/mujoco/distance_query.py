"""Distances of robot and human hand in MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.geometry.kinematic_tree import BoundingSphere, read_tree
from handover_marl.simulation.mujoco.batch_simulation import HandKinematics
from handover_marl.simulation.mujoco.models.collision_shapes import compute_bounding_spheres
from handover_marl.simulation.mujoco.models.scene_spec import SceneModelBuilder


class DistanceQuery:
    """Distance query between the shapes of a Panda and of human hands, with one model for each hand.

    Args:
        panda_urdf: Model of the robot.
        config: Base pose of the robot.
    """

    def __init__(self, panda_urdf: Path, config: PandaConfig) -> None:
        self._panda_urdf, self._config = panda_urdf, PhysicsConfig(panda=config)
        self._pairs: dict[Path, _RobotHandPair] = {}

    def read_bounding_spheres(self, urdf: Path) -> dict[int, BoundingSphere]:
        """Return the bounding spheres of all links with collision shapes, by link number; -1 is the base."""
        return compute_bounding_spheres(urdf, read_tree(urdf))

    def measure(self, hand_urdf: Path, robot: list[float], hand: list[float], max_distance: float) -> float:
        """Measure the smallest distance between the surfaces of robot and human hand (m).

        The result is at most `max_distance`; it is 0 or negative if robot and hand overlap.

        Args:
            hand_urdf: Model of the human hand.
            robot: Nine joint positions of the Panda (rad, m).
            hand: 51 joint positions of the hand (m, rad).
            max_distance: Distance (m) beyond which no search is needed.
        """
        if hand_urdf not in self._pairs:
            self._pairs[hand_urdf] = _RobotHandPair(self._panda_urdf, hand_urdf, self._config)
        return self._pairs[hand_urdf].measure(robot, hand, max_distance)


class _RobotHandPair:
    """MuJoCo model of a Panda and a human hand with the shapes of scene models."""

    def __init__(self, panda_urdf: Path, hand_urdf: Path, config: PhysicsConfig) -> None:
        built = SceneModelBuilder(config)
        built.add_robot(panda_urdf)
        built.add_hand(hand_urdf)
        self._model = model = built.spec.compile()
        self._data = mujoco.MjData(model)
        self._hand = HandKinematics(hand_urdf, built.hand_links)
        is_hand = model.body_mocapid[model.geom_bodyid] >= 0
        self._pairs = np.array([(a, b) for a in np.flatnonzero(~is_hand) for b in np.flatnonzero(is_hand)])
        # Sum of the collision margins of both shapes of each pair (m).
        self._margins = model.geom_margin[self._pairs].sum(axis=1)

    def measure(self, robot: list[float], hand: list[float], max_distance: float) -> float:
        """Measure the smallest distance (m) between the surfaces, see `DistanceQuery.measure`."""
        model, data = self._model, self._data
        poses = self._hand.compute_poses(np.array([hand]))
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = robot, poses[0][0], poses[1][0]
        mujoco.mj_kinematics(model, data)
        first, second = self._pairs.T
        between = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
        bounds = between - model.geom_rbound[first] - model.geom_rbound[second] - self._margins
        nearest = max_distance
        for number in np.argsort(bounds):
            if bounds[number] >= nearest:
                break
            margin, pair = float(self._margins[number]), self._pairs[number].tolist()
            found = mujoco.mj_geomDistance(model, data, *pair, nearest + margin, None)
            nearest = min(nearest, found - margin)
        return nearest
