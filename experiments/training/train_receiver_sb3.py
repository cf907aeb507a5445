"""Train a receiver from scratch for a frozen giver with Stable-Baselines3's PPO.

The script needs the extra `train`, and by default MuJoCo; `--physics fast` does not need it, but is slower.

    python experiments/training/train_receiver_sb3.py --data-dir DIR --out runs/receiver

The policy learns when to close the gripper, and to correct the approach to a grasp
(`handover_marl.learning.receiver_schemes.GraspServoScheme`), from the sparse reward, on nine tenths of a training
split, with evaluations without exploration noise on the validation split. The folder gets `policy.npz` (`--receivers
learned:runs/receiver/policy.npz`), `progress.csv`, TensorBoard logs, and a checkpoint, from which `--resume` continues.
"""

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from stable_baselines3 import PPO

from handover_marl.learning.training.scene_arguments import run_script
from handover_marl.learning.training.stable_baselines import PpoArgs, train_agent


@dataclass(frozen=True)
class Args(PpoArgs):
    """Arguments of the training of a receiver for a frozen giver.

    Attributes:
        giver: Name of the frozen giver.
        gripper_initial_std: Initial standard deviation of the output that closes the gripper.
    """

    out: str = "runs/receiver"
    decisions: int = 500_000
    minutes: float = 24.0
    eval_interval: int = 24_576
    giver: str = "cooperative"
    learning_rate: float = 7e-4
    discount: float = 0.97
    initial_std: float = 0.15
    gripper_initial_std: float = 0.45


def main(args: Args) -> Path:
    return train_agent(
        args, "train_receiver_sb3", "receiver", args.giver, functools.partial(explore_gripper, args.gripper_initial_std)
    )


def explore_gripper(initial_std: float, model: PPO) -> None:
    """Set the initial deviation of the output that closes the gripper: random closing succeeds now and then."""
    with torch.no_grad():
        model.policy.log_std[-1] = math.log(initial_std)


if __name__ == "__main__":
    print(run_script(main, Args))
