"""Receiver that fails, for tests of how errors are reported."""

import numpy as np

from handover_marl.receivers import Receiver


class Failing(Receiver):
    """Receiver that raises a KeyError in its third decision."""

    name, control_period = "failing", 0.13

    def reset(self, seed: int | None = None) -> None:
        self.decisions = 0

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.decisions += 1
        if self.decisions == 3:
            raise KeyError("nonsense")
        return observation["robot_joint_position"]
