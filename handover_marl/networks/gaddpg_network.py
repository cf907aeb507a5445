"""GA-DDPG's actor: from points and the decisions left to the next hand pose.

It tells an action, and as an auxiliary the grasp that it goes for. The original acts by its action. The library's own
weights act by the grasp, from which the step follows by the rule that the expert moved by
(`handover_marl.planning.approach`): that rule jumps where the hand is to go in, which no network learns well.
"""

from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from handover_marl.models.poses import IDENTITY
from handover_marl.networks.one_thread import one_thread
from handover_marl.networks.own_weights import KeptNetwork
from handover_marl.networks.point_encoders import PointNetPlusPlus
from handover_marl.networks.policy_heads import Decision, PolicyHead
from handover_marl.planning.approach import ApproachConfig, steps_to_goals

#: A cloud of this many points is the network's; every other has the gripper's six in front, which it leaves out.
N_POINTS, N_FINGER_POINTS = 1024, 6


class GaddpgNetwork(KeptNetwork):
    """Encoder and head, as the receiver `gaddpg` asks them: `decide`.

    Args:
        approach: The rule by which it goes to the grasp that it tells; None acts as it tells to act.
        max_steps: Decisions that an approach of its may take, or None where that is not its to say.

    Attributes:
        approach: The same.
        max_steps: The same.
        features: The encoder, of xyz in the hand link's frame (m) and a flag that is 0.
        policy: The head.
    """

    kind, eight_bits = "gaddpg", True

    def __init__(self, approach: ApproachConfig | None = None, max_steps: int | None = None) -> None:
        super().__init__()
        self.approach, self.max_steps = approach, max_steps
        self.features = PointNetPlusPlus(4)
        self.policy = PolicyHead()

    def forward(self, cloud: Tensor, remaining: Tensor) -> Decision:
        """Decide.

        Args:
            cloud: (B, 4, 1024), or with the gripper's six points in front.
            remaining: (B,) decisions left.
        """
        if cloud.shape[-1] != N_POINTS:
            cloud = cloud[..., N_FINGER_POINTS:]
        decision: Decision = self.policy(self.features(cloud), remaining)
        return decision

    def decide(self, points: npt.NDArray[np.float64], remaining: int) -> npt.NDArray[np.float32]:
        """(6,) the step for (4, 1030) points and the decisions left; nothing is learned from it."""
        step: npt.NDArray[np.float32] = self.steps(points[None], np.array([float(remaining)]))[0]
        return step

    def steps(self, clouds: npt.NDArray[np.float64], remaining: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """(B, 6) for clouds (B, 4, 1030 or 1024) and decisions left (B,), whatever the number of threads."""
        self.eval()
        device = next(self.parameters()).device
        with one_thread():
            cloud = torch.from_numpy(clouds.astype(np.float32)).to(device)
            decision = self(cloud, torch.from_numpy(remaining.astype(np.float32)).to(device))
        if self.approach is None:
            told: npt.NDArray[np.float32] = decision.action.cpu().numpy()
            return told
        goals = _poses(decision.goal.cpu().numpy().astype(np.float64))
        return steps_to_goals(np.tile(IDENTITY, (len(goals), 1)), goals, remaining, self.approach).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        """By which rule it goes to a grasp, and for how long."""
        approach = None if self.approach is None else asdict(self.approach)
        return {"approach": approach, "max_steps": self.max_steps}

    @classmethod
    def of(cls, settings: dict[str, Any]) -> "GaddpgNetwork":
        """An untrained one."""
        approach = settings.get("approach")
        return cls(None if approach is None else ApproachConfig(**approach), settings.get("max_steps"))


def _poses(goals: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(B, 7) xyz and quaternion xyzw of goals as the head tells them, quaternion wxyz, then xyz."""
    turns = goals[:, [1, 2, 3, 0]]
    return np.concatenate([goals[:, 4:], turns / np.linalg.norm(turns, axis=1, keepdims=True)], axis=1)
