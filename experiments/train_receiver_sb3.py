"""Train a receiver from scratch with Stable-Baselines3's PPO, the giver frozen.

Needs the extras `train`, `plot` and, for its default, `mujoco`; `--physics fast` is there for who has none, and slower.

    python experiments/train_receiver_sb3.py --data-dir DIR --out runs/receiver

Learns when to close the gripper, and how to come to a grasp better than straight along its axis
(`handover_marl.learning.receiver_schemes.GraspServo`), from the task's sparse reward, on nine
tenths of a training split, and looks at the validation split now and then, where it acts without noise. The folder
gets `policy.npz` (`--receivers learned:runs/receiver/policy.npz`), `learning_curve.csv` and `.png`, TensorBoard
logs, and a checkpoint: `--resume` goes on where a run was stopped.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from stable_baselines3 import PPO

from handover_marl.envs.encode import EncodedEnv
from handover_marl.training.ppo import PpoArgs, train_ppo


@dataclass(frozen=True)
class Args(PpoArgs):
    """What to train, and how.

    Attributes:
        giver: The frozen giver.
        gripper_spread: Standard deviation at first of the last output, which closes the gripper.
    """

    out: str = "runs/receiver"
    physics: str = "mujoco"
    observe: str = "close"
    actions: str = "grasp_servo"
    rewards: str = "sparse"
    control_period: float = 0.2
    minutes: float = 24.0
    time_limit: float = 8.0
    spread: float = 0.15
    learning_rate: float = 7e-4
    discount: float = 0.97
    every: int = 24_576
    width: int = 128
    giver: str = "cooperative"
    gripper_spread: float = 0.45


def main(args: Args) -> Path:
    def prepare(model: PPO, make: Callable[[], EncodedEnv]) -> None:
        with torch.no_grad():
            # A wider draw here than of the gripper's way: to close at random is to succeed now and then.
            model.policy.log_std[-1] = math.log(args.gripper_spread)

    return train_ppo(args, "receiver", args.giver, "train_receiver_sb3", prepare)


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
