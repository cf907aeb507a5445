"""Train a giver for a frozen receiver with Stable-Baselines3's PPO. Needs the extras `train` and `plot`.

    python experiments/train_giver_sb3.py --data-dir DIR --out runs/giver

One decision an episode: where and how to hold the object out (`handover_marl.learning.giver_schemes.Offer`); all
that a person does besides is scripted. Starts from what `cooperative` would decide (`--teacher ''` for from
scratch), trains on nine tenths of a training split in fast physics, and looks at the validation split now and
then. The folder gets `policy.npz` (`--givers learned:runs/giver/policy.npz`),
`learning_curve.csv` and `.png`, TensorBoard logs, and a checkpoint: `--resume` goes on where a run was stopped.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro
from stable_baselines3 import PPO

from handover_marl.envs.encode import EncodedEnv
from handover_marl.training.imitation import imitate
from handover_marl.training.ppo import PpoArgs, train_ppo


@dataclass(frozen=True)
class Args(PpoArgs):
    """What to train, and how. With the action scheme offer an episode is one decision.

    Attributes:
        receiver: The frozen receiver.
        teacher: Giver to imitate at first, or nothing.
        demonstrations: Its decisions to learn from.
        passes: Over them.
    """

    out: str = "runs/giver"
    observe: str = "giver"
    actions: str = "offer"
    rewards: str = "shaped"
    steps: int = 512
    minutes: float = 30.0
    time_limit: float = 6.0
    batch: int = 512
    epochs: int = 4
    spread: float = 0.25
    trace: float = 1.0
    every: int = 512
    receiver: str = "yang2021"
    teacher: str = "cooperative"
    demonstrations: int = 648
    passes: int = 300


def main(args: Args) -> Path:
    def prepare(model: PPO, make: Callable[[], EncodedEnv]) -> None:
        if not args.teacher:
            return
        env = make()
        missed = imitate(model, env, args.teacher, episodes=args.demonstrations, epochs=args.passes, seed=args.seed)
        print(f"outputs differ from {args.teacher}'s by {missed:.3f} (root mean square)")
        env.close()

    return train_ppo(args, "giver", args.receiver, "train_giver_sb3", prepare)


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
