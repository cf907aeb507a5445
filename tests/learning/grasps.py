"""The known grasp of lowest cost in one observation, for tests."""

import numpy as np

from handover_marl.episode.observations import Observation
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.policies.policy import PolicyContext


def select_grasp(context: PolicyContext, observation: Observation) -> tuple[np.ndarray, float] | None:
    """Return the world pose (7,) of the hand link at the grasp and the clearance of the person's hand there (m)."""
    batch = {key: values[None] for key, values in observation.items()}
    grasps, clearances, exists = LowestCostGraspSelector(context, 1).select(np.array([0]), batch)
    return (grasps[0], float(clearances[0])) if exists[0] else None
