"""Random observations of many episodes, features of one, and grasps of lowest cost, for tests of encodings."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation, add_episode_axis, giver_observation_space
from handover_marl.geometry.arrays import ONLY_ROW
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.encodings.registry import list_features, list_schemes, make_array_features
from handover_marl.policies.policy import PolicyContext, make_policy_context
from tests.givers.test_givers import START, seen

CONTEXT = make_policy_context(SyntheticDataset())
COUNT = 24
ROWS = np.arange(COUNT)


class SingleFeatures:
    """Features of one agent in a single episode, whose observations have no axis of episodes."""

    def __init__(self, agent: str, choice: Any, context: PolicyContext) -> None:
        self.features = make_array_features(agent, choice, context, LowestCostGraspSelector(context, 1), 1)

    def __call__(self, observation: Observation) -> np.ndarray:
        found: np.ndarray = self.features(ONLY_ROW, add_episode_axis(observation))[0]
        return found


def select(observation: Observation, rows: np.ndarray) -> Observation:
    return {key: values[rows] for key, values in observation.items()}


def draw_observation(seed: int) -> Observation:
    """Draw observations (COUNT, ...) of all keys, with objects with and without grasps."""
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(4 * COUNT, random_state=seed).as_quat().astype(np.float32).reshape(4, COUNT, 4)
    space = giver_observation_space()
    found = {key: rng.normal(size=(COUNT, *own.shape)).astype(np.float32) for key, own in space.items()}
    base = seen()
    for number, key in enumerate(("gripper_pose", "object_poses", "replay_object_poses", "replay_wrist_poses")):
        poses = np.tile(base[key], (COUNT, *[1] * base[key].ndim)) + 0.1 * found[key]
        poses[..., 3:] = rotations[number] if poses.ndim == 2 else rotations[number][:, None]
        found[key] = poses.astype(np.float32)
    found["hand_keypoints"] = (base["hand_keypoints"] + 0.05 * found["hand_keypoints"]).astype(np.float32)
    found["robot_joint_position"] = (START + 0.1 * found["robot_joint_position"]).astype(np.float32)
    found["object_classes"][:] = 0.0
    found["object_classes"][:, 0] = rng.choice([1, 2, 5, 14, 16, 21], COUNT)
    for key in ("hand_present", "released", "holding"):
        found[key] = (rng.random((COUNT, 1)) < 0.7).astype(np.float32)
    found["time"] = rng.uniform(0.0, 5.0, (COUNT, 1)).astype(np.float32)
    return found


AGENTS = ("giver", "receiver")
FEATURES = [(agent, name) for agent in AGENTS for name in list_features(agent)]
SCHEMES = [(agent, name) for agent in AGENTS for name in list_schemes(agent)]


def select_grasp(context: PolicyContext, observation: Observation) -> tuple[np.ndarray, float] | None:
    """Return the world pose (7,) of the hand link at the grasp and the clearance of the person's hand there (m)."""
    batch = {key: values[None] for key, values in observation.items()}
    grasps, clearances, exists = LowestCostGraspSelector(context, 1).select(np.array([0]), batch)
    return (grasps[0], float(clearances[0])) if exists[0] else None
