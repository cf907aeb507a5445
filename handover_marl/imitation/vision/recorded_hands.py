"""Persons' hands in recordings, as bodies that a gripper keeps clear of."""

import numpy as np
import numpy.typing as npt

from handover_marl.datasets.scene import Scene
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.planning.gripper_room import Balls
from handover_marl.planning.person_motion import HandMotion
from handover_marl.sim.hand_path import keypoint_links

Array = npt.NDArray[np.float64]


def recorded_hand(scene: Scene, frame: int) -> Balls | None:
    """The hand of a scene at a frame in the world, or None if there is none then.

    Raises:
        SimulationError: Its model cannot be read.
    """
    if not scene.hand_present(np.array([frame]))[0]:
        return None
    tree = read_tree(scene.assets.hand)
    moving = [link for link, joint in enumerate(tree.joints) if joint.kind != "fixed"]
    dof = scene.hand_dof[frame]
    origins, _ = tree.frames(dof[None])
    motion = HandMotion()
    motion.see(
        0.0,
        {
            "hand_present": np.ones(1, dtype=np.int8),
            "hand_keypoints": origins[0, keypoint_links(moving)].astype(np.float32),
            "hand_dof_position": dof,
        },
    )
    return motion.balls
