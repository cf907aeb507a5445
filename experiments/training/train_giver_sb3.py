"""Train a giver for a frozen receiver with Stable-Baselines3's PPO.

The script needs the extra `train`.

    python experiments/training/train_giver_sb3.py --data-dir DIR --out runs/giver

An episode is one decision: the handover pose of the object (`handover_marl.learning.giver_schemes.HandoverPoseScheme`);
the rest of the person's motion is scripted. The policy first imitates the giver `cooperative` (`--teacher ''` trains
from scratch), then learns on nine tenths of a training split in fast physics, with evaluations on the validation split.
The folder gets `policy.npz` (`--givers learned:runs/giver/policy.npz`), `progress.csv`, TensorBoard logs, and a
checkpoint, from which `--resume` continues.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3 import PPO

import handover_marl
from handover_marl import givers
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.learning.schemes import make_scheme, outputs_from_action
from handover_marl.learning.training.run_folder import spawn_seeds
from handover_marl.learning.training.scene_arguments import run_script
from handover_marl.learning.training.stable_baselines import PpoArgs, train_agent
from handover_marl.policies.reference import parse_policy

Vectors: TypeAlias = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Args(PpoArgs):
    """Arguments of the training of a giver for a frozen receiver.

    Attributes:
        receiver: Name of the frozen receiver.
        teacher: Name of the giver to imitate before PPO; empty for no imitation.
        demonstrations: Number of episodes whose first decision by the teacher is imitated.
        imitation_epochs: Number of epochs of the imitation.
    """

    out: str = "runs/giver"
    width: int = 64
    time_limit: float = 6.0
    control_period: float = 0.1
    receiver: str = "yang2021"
    teacher: str = "cooperative"
    demonstrations: int = 648
    imitation_epochs: int = 300
    features: str = "giver"
    actions: str = "offer"
    physics: str = "fast"
    decisions: int = 512
    batch_size: int = 512
    eval_interval: int = 512
    epochs: int = 4
    rewards: str = "shaped"
    learning_rate: float = 3e-4
    discount: float = 0.99
    gae_lambda: float = 1.0
    initial_std: float = 0.25


def main(args: Args) -> Path:
    parse_policy("giver", args.teacher or "replay")  # checks the name before the run's folder is made
    return train_agent(args, "train_giver_sb3", "giver", args.receiver, functools.partial(imitate, args))


def imitate(args: Args, model: PPO) -> None:
    """Train the model's policy to imitate the teacher's first decision in many episodes, if there is a teacher."""
    if not args.teacher:
        return
    inputs, targets = map(torch.as_tensor, record_first_decisions(args))
    optimizer = torch.optim.Adam(model.policy.parameters(), lr=1e-3)
    generator = torch.Generator().manual_seed(args.seed)
    for _ in range(args.imitation_epochs):
        for part in torch.randperm(args.demonstrations, generator=generator).chunk(max(1, args.demonstrations // 64)):
            loss = (compute_means(model, inputs[part]) - targets[part]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    with torch.no_grad():
        error = float((compute_means(model, inputs) - targets).square().mean().sqrt())
    print(f"outputs differ from those of {args.teacher} by {error:.3f} (root mean square)")


def record_first_decisions(args: Args, workers: int | None = None) -> tuple[Vectors, Vectors]:
    """Return features (n, m) of n episodes' first decisions, and the outputs (n, 7) nearest to the teacher's actions.

    Args:
        args: Arguments of the training.
        workers: Number of processes, on which the decisions do not depend; default: one per core.
    """

    def make_recorder() -> Callable[[int], tuple[Vectors, Vectors]]:
        env = handover_marl.freeze(handover_marl.parallel_env(args.make_env_config()), "giver", args.receiver)
        env = handover_marl.encode(env, args.features, args.actions)
        scheme = make_scheme("giver", args.actions, env.unwrapped.policy_context)
        teacher = givers.make(args.teacher, args.open_dataset())

        def record(seed: int) -> tuple[Vectors, Vectors]:
            features = env.reset(seed=seed)[0]["giver"]
            teacher.reset(seed)
            observation = env.get_last_observation("giver")
            return features, outputs_from_action(scheme, teacher.act(observation), observation)

        return record

    seeds = spawn_seeds(args.demonstrations, args.seed)
    found = dict(map_with_progress(make_recorder, seeds, "first decisions", PoolConfig(workers), progress=True))
    inputs, outputs = zip(*(found[seed] for seed in seeds), strict=True)
    return np.stack(inputs), np.stack(outputs)


def compute_means(model: PPO, inputs: torch.Tensor) -> torch.Tensor:
    distribution: Any = model.policy.get_distribution(inputs).distribution
    means: torch.Tensor = distribution.mean
    return means


if __name__ == "__main__":
    print(run_script(main, Args))
