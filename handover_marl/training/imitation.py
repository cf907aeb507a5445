"""A head start: a giver's policy first learns to do as a scripted giver does. Needs the extra `train`."""

from typing import Any

import numpy as np
import torch
from rich.progress import track
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from handover_marl import givers
from handover_marl.envs.encode import EncodedEnv


def imitate(model: OnPolicyAlgorithm, env: EncodedEnv, giver: str, *, episodes: int, epochs: int, seed: int) -> float:
    """Fit a policy's mean outputs to what a giver does at the first decision of many episodes.

    Args:
        model: Whose policy learns.
        env: A giver's, where decisions come from; only played up to the first one.
        giver: Name of the giver.
        episodes: Decisions to learn from.
        epochs: Passes over them.
        seed: Of scenes and order.

    Returns:
        Root mean square of what is left of the difference, in outputs.

    Raises:
        OptionError: The environment's action scheme cannot imitate.
    """
    teacher = givers.make(giver, env.world.dataset)
    seen, wanted = [], []
    for episode in track(range(episodes), description=f"watching {giver}"):
        features, _ = env.reset(seed=seed if episode == 0 else None)
        teacher.reset(episode)
        seen.append(features["giver"])
        wanted.append(env.outputs_of("giver", teacher.act(env.observed("giver"))))
    inputs, targets = torch.as_tensor(np.stack(seen)), torch.as_tensor(np.stack(wanted))
    optimizer = torch.optim.Adam(model.policy.parameters(), lr=1e-3)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(epochs):
        for part in torch.randperm(episodes, generator=generator).chunk(max(1, episodes // 64)):
            missed = (_means(model, inputs[part]) - targets[part]).square().mean()
            optimizer.zero_grad()
            missed.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
    with torch.no_grad():
        return float((_means(model, inputs) - targets).square().mean().sqrt())


def _means(model: OnPolicyAlgorithm, inputs: torch.Tensor) -> torch.Tensor:
    distribution: Any = model.policy.get_distribution(inputs).distribution
    means: torch.Tensor = distribution.mean
    return means
