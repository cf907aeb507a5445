"""What makes an action and a goal of an encoder's vector and the time that is left."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as func
from torch import Tensor, nn

#: Largest translation (m) and Euler angle (rad) of one decision, each along or about every axis.
LARGEST_SHIFT, LARGEST_TURN = 0.06, math.pi / 6.0
_LOG_DEVIATION = (-10.0, 2.0)


class Decision(NamedTuple):
    """What a policy's head says; the hand's next pose and the grasp are in the present hand link's frame.

    Attributes:
        action: (B, 6) most likely action: translation (m), then Euler angles (rad) about x, y, z, axes at rest.
        mean: (B, 6) the same before it was squashed by tanh and scaled.
        log_deviation: (B, 6) logarithm of the standard deviation, before likewise.
        goal: (B, 7) pose of the grasp: unit quaternion wxyz, then xyz (m).
    """

    action: Tensor
    mean: Tensor
    log_deviation: Tensor
    goal: Tensor


class PolicyHead(nn.Module):
    """The actor of GA-DDPG and handover-sim2real: two hidden layers, then action and goal.

    Layers have the names of the original, so that its weights fit; they start as Xavier says.

    Args:
        n_features: Length of the encoder's vector.
        timed: Whether it is told the decisions left, as a raw number behind the vector; GenH2R's is not.
        n_hidden: Width of the hidden layers.
    """

    def __init__(self, n_features: int = 512, timed: bool = True, n_hidden: int = 256) -> None:
        super().__init__()
        self.timed = timed
        self.linear1 = nn.Linear(n_features + timed, n_hidden)
        self.linear2 = nn.Linear(n_hidden, n_hidden)
        self.mean = nn.Linear(n_hidden, 6)
        self.log_std_linear = nn.Linear(n_hidden, 6)
        self.extra_pred = nn.Linear(n_hidden, 7)
        self.scale: Tensor
        self.register_buffer("scale", torch.tensor([LARGEST_SHIFT] * 3 + [LARGEST_TURN] * 3), persistent=False)
        for layer in (self.linear1, self.linear2, self.mean, self.log_std_linear, self.extra_pred):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, features: Tensor, remaining: Tensor | None = None) -> Decision:
        """Decide.

        Args:
            features: (B, n_features).
            remaining: (B,) decisions left; None for a head that is not told.

        Raises:
            ValueError: The time is lacking, or told to a head that does not want it.
        """
        if self.timed != (remaining is not None):
            raise ValueError(f"this head is {'' if self.timed else 'not '}told the decisions left")
        if remaining is not None:
            features = torch.cat([features, remaining[:, None].to(features.dtype)], dim=1)
        hidden = func.relu(self.linear2(func.relu(self.linear1(features))))
        mean, goal = self.mean(hidden), self.extra_pred(hidden)
        return Decision(
            torch.tanh(mean) * self.scale,
            mean,
            self.log_std_linear(hidden).clamp(*_LOG_DEVIATION),
            torch.cat([func.normalize(goal[:, :4], dim=-1), goal[:, 4:]], dim=-1),
        )
