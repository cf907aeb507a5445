"""Actor of GA-DDPG (Wang et al., CoRL 2021): from a point cloud to the next hand motion.

The actor predicts an action and, as an auxiliary output, the pose of the grasp. The original
executes the action. The weights of this library execute the grasp prediction: the step to it
follows from the expert's rule (`handover_marl.learning.networks.approach_field`), whose
discontinuities a network does not learn well.
"""

import math
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.geometry.poses import IDENTITY
from handover_marl.learning.networks.approach_field import ApproachFieldConfig, compute_approach_steps
from handover_marl.learning.networks.point_encoders import PointNetPlusPlus
from handover_marl.learning.networks.weights import SavedNetwork, single_threaded_inference

#: Number of points of an input cloud, and of gripper points that the receiver puts in front of it.
N_POINTS, N_FINGER_POINTS = 1024, 6
#: Largest translation (m) and Euler angle (rad) of one decision, along or about each axis.
MAX_TRANSLATION, MAX_ROTATION = 0.06, math.pi / 6.0
_LOG_DEVIATION = (-10.0, 2.0)


class ActorOutput(NamedTuple):
    """Outputs of GA-DDPG's actor for B clouds, in the present frame of the hand link.

    Attributes:
        action: (B, 6) mean action: translation (m), then extrinsic xyz Euler angles (rad).
        mean: (B, 6) mean action before squashing by tanh and scaling.
        log_deviation: (B, 6) logarithm of the standard deviation of the unsquashed action.
        goal: (B, 7) grasp pose of the hand link: unit quaternion wxyz, then position xyz (m).
    """

    action: Tensor
    mean: Tensor
    log_deviation: Tensor
    goal: Tensor


class PolicyHead(nn.Module):
    """Head of the actors of GA-DDPG and handover-sim2real: two hidden layers, action and goal.

    Layers are named as in GA-DDPG's code, so that the original weights can be loaded, and
    initialized by Xavier's method.

    Args:
        n_features: Length of the encoder's feature vector.
        uses_remaining_steps: Whether the number of remaining decisions is an additional input;
            False in GenH2R.
        n_hidden: Width of the hidden layers.
    """

    def __init__(self, n_features: int = 512, uses_remaining_steps: bool = True, n_hidden: int = 256) -> None:
        super().__init__()
        self.uses_remaining_steps = uses_remaining_steps
        self.linear1 = nn.Linear(n_features + uses_remaining_steps, n_hidden)
        self.linear2 = nn.Linear(n_hidden, n_hidden)
        self.mean = nn.Linear(n_hidden, 6)
        self.log_std_linear = nn.Linear(n_hidden, 6)
        self.extra_pred = nn.Linear(n_hidden, 7)
        self.scale: Tensor
        self.register_buffer("scale", torch.tensor([MAX_TRANSLATION] * 3 + [MAX_ROTATION] * 3), persistent=False)
        for layer in (self.linear1, self.linear2, self.mean, self.log_std_linear, self.extra_pred):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, features: Tensor, remaining: Tensor | None = None) -> ActorOutput:
        """Compute action and grasp pose.

        Args:
            features: (B, n_features) outputs of the encoder.
            remaining: (B,) numbers of remaining decisions; None if the head does not use them.

        Raises:
            ValueError: `remaining` is missing, or passed to a head that does not use it.
        """
        if self.uses_remaining_steps != (remaining is not None):
            wanted = "a tensor" if self.uses_remaining_steps else "None"
            raise ValueError(f"remaining must be {wanted} for this head, got {type(remaining).__name__}")
        if remaining is not None:
            features = torch.cat([features, remaining[:, None].to(features.dtype)], dim=1)
        hidden = func.relu(self.linear2(func.relu(self.linear1(features))))
        mean, goal = self.mean(hidden), self.extra_pred(hidden)
        return ActorOutput(
            torch.tanh(mean) * self.scale,
            mean,
            self.log_std_linear(hidden).clamp(*_LOG_DEVIATION),
            torch.cat([func.normalize(goal[:, :4], dim=-1), goal[:, 4:]], dim=-1),
        )


class GaddpgNetwork(SavedNetwork):
    """Encoder and head of GA-DDPG's actor, for the receiver `gaddpg`.

    Args:
        approach: Rule that turns the predicted grasp into a step; None executes the action output.
        max_steps: Number of decisions of an approach; None leaves it to the receiver.

    Attributes:
        features: Encoder of clouds with channels xyz in the hand link's frame (m) and a zero.
        policy: Head of the actor.
    """

    kind, uses_int8 = "gaddpg", True

    def __init__(self, approach: ApproachFieldConfig | None = None, max_steps: int | None = None) -> None:
        super().__init__()
        self.approach, self.max_steps = approach, max_steps
        self.features = PointNetPlusPlus(4)
        self.policy = PolicyHead()

    def forward(self, cloud: Tensor, remaining: Tensor) -> ActorOutput:
        """Compute action and grasp pose.

        Args:
            cloud: (B, 4, 1024) clouds, or (B, 4, 1030) with the gripper's points in front.
            remaining: (B,) numbers of remaining decisions.
        """
        if cloud.shape[-1] != N_POINTS:
            cloud = cloud[..., N_FINGER_POINTS:]
        output: ActorOutput = self.policy(self.features(cloud), remaining)
        return output

    def predict_step(self, points: npt.NDArray[np.float64], remaining: int) -> npt.NDArray[np.float32]:
        """Return the next motion (6,) of the hand for one cloud (4, 1030), as `predict_steps`."""
        step: npt.NDArray[np.float32] = self.predict_steps(points[None], np.array([float(remaining)]))[0]
        return step

    def predict_steps(
        self, clouds: npt.NDArray[np.float64], remaining: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float32]:
        """Return the next motions of the hand, without gradients and on one thread.

        Args:
            clouds: (B, 4, 1024 or 1030) clouds as in `forward`.
            remaining: (B,) numbers of remaining decisions.

        Returns:
            (B, 6) translations (m) and extrinsic xyz Euler angles (rad) in the hand link's frame.
        """
        self.eval()
        device = next(self.parameters()).device
        with single_threaded_inference():
            cloud = torch.from_numpy(clouds.astype(np.float32)).to(device)
            output = self(cloud, torch.from_numpy(remaining.astype(np.float32)).to(device))
        if self.approach is None:
            action: npt.NDArray[np.float32] = output.action.cpu().numpy()
            return action
        goals = _poses_from_goals(output.goal.cpu().numpy().astype(np.float64))
        present = np.tile(IDENTITY, (len(goals), 1))
        return compute_approach_steps(present, goals, remaining, self.approach).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        """Return the approach rule and the number of decisions in JSON types."""
        approach = None if self.approach is None else asdict(self.approach)
        return {"approach": approach, "max_steps": self.max_steps}

    @classmethod
    def from_settings(cls, settings: dict[str, Any]) -> "GaddpgNetwork":
        """Create an untrained network from its arguments, as returned by `settings`."""
        approach = settings.get("approach")
        return cls(None if approach is None else ApproachFieldConfig.from_settings(approach), settings.get("max_steps"))


def _poses_from_goals(goals: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return poses (B, 7), xyz and quaternion xyzw, of goals (B, 7), quaternion wxyz and xyz."""
    quaternions = goals[:, [1, 2, 3, 0]]
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.concatenate([goals[:, 4:], unit], axis=1)
