"""Distances of robot and human hand in MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np

from handover_marl.config import PandaConfig, PhysicsConfig
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.simulation.mujoco.batch_simulation import HandKinematics
from handover_marl.simulation.mujoco.models.collision_shapes import compute_bounding_spheres
from handover_marl.simulation.mujoco.models.scene_spec import SceneModelBuilder


class RobotHandDistance:
    """Distance between the collision shapes of a Panda and of a human hand, which MuJoCo measures.

    Args:
        panda_urdf: Model of the robot.
        hand_urdf: Model of the human hand.
        config: Base pose of the robot.

    Attributes:
        robot_spheres: Bounding spheres of the robot's links with collision shapes, by link number; -1 is the base.
        hand_spheres: Bounding spheres of the hand's links.
    """

    def __init__(self, panda_urdf: Path, hand_urdf: Path, config: PandaConfig) -> None:
        self.robot_spheres, self.hand_spheres = (
            compute_bounding_spheres(urdf, read_tree(urdf)) for urdf in (panda_urdf, hand_urdf)
        )
        built = SceneModelBuilder(PhysicsConfig(panda=config))
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
        """Measure the smallest distance between the surfaces (m), at most `max_distance`; 0 or negative on overlap.

        Args:
            robot: Nine joint positions of the Panda (rad, m).
            hand: 51 joint positions of the hand (m, rad).
            max_distance: Distance (m) beyond which no search is needed.
        """
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
