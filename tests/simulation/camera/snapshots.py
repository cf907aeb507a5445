"""Random joint positions in which the wrist camera sees hand and objects, for both ray casters."""

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import MAX_OBJECTS, PhysicsConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.geometry.arrays import ArrayFactory
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import HAND_LINK, LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.rotations import quaternions_from_euler
from handover_marl.simulation.camera.images import JointSnapshot
from handover_marl.simulation.camera.optics import WRIST_CAMERA
from handover_marl.simulation.world import WorldState


def draw_snapshot(
    scene: Scene,
    config: PhysicsConfig,
    rng: np.random.Generator,
    has_hand: bool = True,
    nearest: float = 0.0,
    farthest: float = 0.6,
) -> JointSnapshot:
    """Draw an arm pose, and poses of hand and objects at distances (m) before the camera; bodies may overlap."""
    low, high = np.array(LOWER_LIMITS), np.array(UPPER_LIMITS)
    robot = (low + rng.uniform(0.1, 0.9, 9) * (high - low)).astype(np.float32)
    count = len(scene.assets.objects) + 1
    ahead = rng.uniform(nearest, farthest, (count, 1))
    aside = rng.uniform(-0.7, 0.7, (count, 2)) * np.maximum(np.abs(ahead), 0.05)
    dof = np.c_[place_in_view(scene, config, robot, np.c_[aside, ahead]), rng.uniform(-np.pi, np.pi, (count, 3))]
    hand = np.concatenate([dof[0], rng.uniform(-0.8, 0.8, 45)]).astype(np.float32)
    return JointSnapshot(robot, hand if has_hand else None, dof[1:].astype(np.float32))


def place_in_view(
    scene: Scene, config: PhysicsConfig, robot: npt.NDArray[np.float32], places: npt.ArrayLike
) -> npt.NDArray[np.float64]:
    """Return world positions (n, 3) of points given right, down and ahead of the camera (m)."""
    tree = read_tree(scene.assets.panda)
    origins, turns = (value[0] for value in tree.compute_link_frames(robot[None]))
    link = tree.get_link(HAND_LINK)
    base = Rotation.from_quat(config.panda.base_orientation)
    points = np.asarray(places) @ np.array(WRIST_CAMERA.axes).T + WRIST_CAMERA.position
    return np.asarray(base.apply(points @ turns[link].T + origins[link]) + config.panda.base_position)


def stack_states(snapshots: list[JointSnapshot], arrays: ArrayFactory) -> WorldState:
    """Return the states (n, ...) of n worlds with these joints at rest as tensors, as far as a camera sees them."""
    objects = np.zeros((len(snapshots), MAX_OBJECTS, 7))
    for own, one in zip(objects, snapshots, strict=True):
        own[: len(one.objects)] = np.c_[one.objects[:, :3], quaternions_from_euler(one.objects[:, 3:])]
    hands = [np.zeros(51, np.float32) if one.hand is None else one.hand for one in snapshots]
    return WorldState.from_zeros(len(snapshots), arrays)._replace(
        robot_joint_position=arrays.asarray(np.array([one.robot for one in snapshots])),
        hand_dof_position=arrays.asarray(np.array(hands)),
        hand_present=arrays.asarray(np.array([[one.hand is not None] for one in snapshots]), "float32"),
        object_poses=arrays.asarray(objects, "float32"),
    )
