"""GA-DDPG's actor: from points and the decisions left to the next hand pose."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from handover_marl.networks.one_thread import one_thread
from handover_marl.networks.own_weights import KeptNetwork
from handover_marl.networks.point_encoders import PointNetPlusPlus
from handover_marl.networks.policy_heads import Decision, PolicyHead

#: A cloud of this many points is the network's; every other has the gripper's six in front, which it leaves out.
N_POINTS, N_FINGER_POINTS = 1024, 6


class GaddpgNetwork(KeptNetwork):
    """Encoder and head, as the receiver `gaddpg` asks them: `decide`.

    Attributes:
        features: The encoder, of xyz in the hand link's frame (m) and a flag that is 0.
        policy: The head.
    """

    kind = "gaddpg"

    def __init__(self) -> None:
        super().__init__()
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
        """(6,) the most likely action for (4, 1030) points and the decisions left; nothing is learned from it."""
        self.eval()
        device = next(self.parameters()).device
        with one_thread():
            cloud = torch.from_numpy(points.astype(np.float32))[None].to(device)
            decision = self(cloud, torch.tensor([float(remaining)], device=device))
        action: npt.NDArray[np.float32] = decision.action[0].cpu().numpy()
        return action
