"""Train a giver for a frozen receiver with Stable-Baselines3's PPO. Needs the extras `train` and `plot`.

    python experiments/train_giver_sb3.py --data-dir DIR --out runs/giver

One decision an episode: where and how to hold the object out (`handover_marl.learning.giver_schemes.Offer`); all
that a person does besides is scripted. Starts from what `cooperative` would decide (`--teacher ''` for from
scratch), trains on nine tenths of a training split in fast physics, and looks at the validation split now and
then. The folder gets `policy.npz` (`--givers learned:runs/giver/policy.npz`),
`learning_curve.csv` and `.png`, TensorBoard logs, and a checkpoint: `--resume` goes on where a run was stopped.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from handover_marl.datasets import open_dataset
from handover_marl.learning.environments import LearningEnv
from handover_marl.learning.imitation import imitate
from handover_marl.learning.policy import PolicySpec
from handover_marl.learning.stable_baselines import Supervision, load_checkpoint, vector_env
from handover_marl.learning.training import RunFolder, evaluate_policy, origin, spread_scenes, training_scenes


@dataclass(frozen=True)
class Args:
    """What to train, and how.

    Attributes:
        out: Folder of the run.
        receiver: Name of the frozen receiver.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: fast or exact.
        actions: Action scheme: offer, deviation or giver.
        control_period: How often the giver looks (s).
        seed: Of everything.
        steps: Decisions at most; with offer an episode is one.
        minutes: Wall-clock time at most (min).
        time_limit: Episodes in training are cut off after so long (s).
        envs: Environments, a process each.
        batch: Decisions between updates.
        learning_rate: Of Adam.
        epochs: Passes over a batch.
        teacher: Giver to imitate at first, or nothing.
        demonstrations: Its decisions to learn from.
        passes: Over them.
        spread: Standard deviation of the outputs at first.
        discount: Of rewards, for schemes with many decisions.
        every: Decisions between evaluations.
        val_scenes: Scenes of the validation split to evaluate on, evenly chosen.
        resume: Go on with the run in the folder.
    """

    out: str = "runs/giver"
    receiver: str = "yang2021"
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    actions: str = "offer"
    control_period: float = 0.1
    seed: int = 0
    steps: int = 512
    minutes: float = 30.0
    time_limit: float = 6.0
    envs: int = 8
    batch: int = 512
    learning_rate: float = 3e-4
    epochs: int = 4
    teacher: str = "cooperative"
    demonstrations: int = 648
    passes: int = 300
    spread: float = 0.25
    discount: float = 0.99
    every: int = 512
    val_scenes: int = 36
    resume: bool = False


def main(args: Args) -> None:
    folder = RunFolder(Path(args.out), args, args.resume)
    common = {"setup": args.setup, "data_dir": args.data_dir, "dataset": args.dataset, "physics": args.physics}
    data = open_dataset(args.dataset, args.data_dir)
    train = training_scenes(data.split(args.setup, "train"))
    val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
    options = common | {
        "agent": "giver",
        "partner": args.receiver,
        "actions": args.actions,
        "scenes": train,
        "split": "train",
        "rewards": "shaped",
        "control_period": args.control_period,
        "time_limit": args.time_limit,
    }
    envs = vector_env(args.envs, args.seed, **options)
    if args.resume and folder.checkpoint.exists():
        model = load_checkpoint(PPO, folder, envs)
    else:
        model = make(args, envs)
        if args.teacher:
            env = LearningEnv(**options)
            missed = imitate(
                model, env, args.teacher, episodes=args.demonstrations, epochs=args.passes, seed=args.seed
            )
            print(f"outputs differ from {args.teacher}'s by {missed:.3f} (root mean square)")
            env.close()
    spec = PolicySpec("giver", "giver", args.actions, args.control_period, origin=origin("train_giver_sb3", args))
    supervision = Supervision(
        folder,
        spec,
        lambda policy: evaluate_policy("giver", policy, args.receiver, split="val", scenes=val, **common),
        args.every,
        args.minutes,
        args.receiver,
    )
    left = max(0, args.steps - model.num_timesteps)
    model.learn(left, supervision, reset_num_timesteps=False, progress_bar=True, log_interval=1)
    supervision.assess()
    envs.close()
    print(folder.policy)


def make(args: Args, envs: VecEnv) -> PPO:
    return PPO(
        "MlpPolicy",
        envs,
        learning_rate=args.learning_rate,
        n_steps=args.batch // args.envs,
        batch_size=128,
        n_epochs=args.epochs,
        gamma=args.discount,
        gae_lambda=1.0,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": math.log(args.spread)},
        tensorboard_log=str(Path(args.out) / "tensorboard"),
        seed=args.seed,
        device="cpu",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
