"""Functions and modules that tests adapt to policies."""

from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

SIZES = {"receiver": (64, 7), "giver": (39, 8)}
CHOICES: dict[str, dict[str, Any]] = {
    "receiver": {"features": "grasp", "action_scheme": "cartesian_delta"},
    "giver": {"features": "giver", "action_scheme": "deviation"},
}
SCALE = 1.0


def stay(observation: dict[str, Any]) -> Any:
    """Return the present joint positions, times SCALE, as the action."""
    return SCALE * observation["robot_joint_position"]


class Counting:
    """Function that moves the joints further with every call; `reset` sets the count of calls to 0."""

    def __init__(self, step: float = 0.001) -> None:
        self.step, self.seed, self.count = step, -1, 0

    def reset(self, seed: int | None = None) -> None:
        self.seed, self.count = seed or 0, 0

    def __call__(self, observation: dict[str, Any]) -> Any:
        self.count += 1
        return observation["robot_joint_position"] + self.step * self.count


class Restarting(Counting):
    """The same function, whose `reset` takes no seed."""

    def reset(self) -> None:  # type: ignore[override]
        self.count = 0


class DictModule(torch.nn.Module):  # type: ignore[misc, name-defined]
    """Module that takes the observation as a dictionary of tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(9))

    def forward(self, observation: Any) -> Any:
        return observation["robot_joint_position"] * self.gain


class NoisyModule(torch.nn.Module):  # type: ignore[misc, name-defined]
    """Module whose outputs are random numbers, as those of a stochastic policy are."""

    def forward(self, inputs: Any) -> Any:
        return torch.randn(1, 7)


def make_net(agent: str = "receiver", seed: int = 0, activation: Any = torch.nn.Tanh) -> Any:
    torch.manual_seed(seed)
    n_inputs, n_outputs = SIZES[agent]
    return torch.nn.Sequential(torch.nn.Linear(n_inputs, 16), activation(), torch.nn.Linear(16, n_outputs))
