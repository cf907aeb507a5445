"""User-defined rewards that tests name as `module:name`."""

import numpy as np

from handover_marl.envs.custom_rewards import combine_rewards
from handover_marl.envs.transition import Transition


def approach(transition: Transition) -> dict[str, dict[str, float]]:
    before, after = (
        np.linalg.norm(state["object_poses"][0, :3] - state["gripper_pose"][:3])
        for state in (transition.state, transition.next_state)
    )
    return {"receiver": {"approach": float(before - after)}}


class Counter:
    """Reward of the giver that equals the number of control steps since the reset."""

    def __init__(self) -> None:
        self.count = 0

    def reset(self, transition: Transition) -> None:
        self.count = 0

    def __call__(self, transition: Transition) -> dict[str, dict[str, float]]:
        self.count += 1
        return {"giver": {"count": self.count}}


SHAPED_AND_OWN = combine_rewards("shaped", (0.5, approach))
