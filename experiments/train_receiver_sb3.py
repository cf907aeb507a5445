"""Train a receiver from scratch with Stable-Baselines3's PPO, the giver frozen. Needs extras `train` and `plot`.

    python experiments/train_receiver_sb3.py --data-dir DIR --out runs/receiver

Learns when to close the gripper, and how to come to a grasp better than straight along its axis
(`handover_marl.learning.receiver_schemes.GraspServo`), from the task's sparse reward in fast physics, on nine
tenths of a training split, and looks at the validation split now and then, where it acts without noise. The folder
gets `policy.npz` (`--receivers learned:runs/receiver/policy.npz`), `learning_curve.csv` and `.png`, TensorBoard
logs, and a checkpoint: `--resume` goes on where a run was stopped.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from handover_marl.datasets import open_dataset
from handover_marl.learning.policy import PolicySpec
from handover_marl.learning.stable_baselines import Supervision, load_checkpoint, vector_env
from handover_marl.learning.training import RunFolder, evaluate_policy, origin, spread_scenes, training_scenes
from handover_marl.rewards import reward_config


@dataclass(frozen=True)
class Args:
    """What to train, and how.

    Attributes:
        out: Folder of the run.
        giver: Name of the frozen giver.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: fast or exact.
        observe: Features: grasp, receiver or flat_receiver.
        actions: Action scheme: grasp_servo, cartesian_delta, joint_delta, joints or receiver.
        rewards: sparse or shaped.
        control_period: How long an action stands (s).
        seed: Of everything.
        steps: Decisions at most.
        minutes: Wall-clock time at most (min).
        time_limit: Episodes in training are cut off after so long (s).
        envs: Environments, a process each.
        batch: Decisions between updates.
        epochs: Passes over a batch.
        spread: Standard deviation of the outputs at first.
        gripper_spread: That of the last one, which closes the gripper.
        learning_rate: Of Adam.
        discount: Of rewards.
        every: Decisions between evaluations.
        val_scenes: Scenes of the validation split to evaluate on, evenly chosen.
        resume: Go on with the run in the folder.
    """

    out: str = "runs/receiver"
    giver: str = "cooperative"
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    observe: str = "grasp"
    actions: str = "grasp_servo"
    rewards: str = "sparse"
    control_period: float = 0.2
    seed: int = 0
    steps: int = 500_000
    minutes: float = 24.0
    time_limit: float = 8.0
    envs: int = 8
    batch: int = 2048
    epochs: int = 8
    spread: float = 0.15
    gripper_spread: float = 0.45
    learning_rate: float = 7e-4
    discount: float = 0.97
    every: int = 8_192
    val_scenes: int = 36
    resume: bool = False


def main(args: Args) -> None:
    torch.set_num_threads(1)
    folder = RunFolder(Path(args.out), args, args.resume)
    common = {"setup": args.setup, "data_dir": args.data_dir, "dataset": args.dataset, "physics": args.physics}
    data = open_dataset(args.dataset, args.data_dir)
    train = training_scenes(data.split(args.setup, "train"))
    val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
    envs = vector_env(
        args.envs,
        args.seed,
        agent="receiver",
        partner=args.giver,
        actions=args.actions,
        observe=args.observe,
        scenes=train,
        split="train",
        # Guidance is made for the learner's own discount.
        rewards=replace(reward_config(args.rewards), gamma=args.discount),
        control_period=args.control_period,
        time_limit=args.time_limit,
        **common,
    )
    model = load_checkpoint(PPO, folder, envs) if args.resume and folder.checkpoint.exists() else make(args, envs)
    supervision = Supervision(
        folder,
        PolicySpec(
            "receiver", args.observe, args.actions, args.control_period, origin("train_receiver_sb3", args)
        ),
        lambda policy: evaluate_policy("receiver", policy, args.giver, split="val", scenes=val, **common),
        args.every,
        args.minutes,
        args.giver,
    )
    left = max(0, args.steps - model.num_timesteps)
    model.learn(left, supervision, reset_num_timesteps=False, progress_bar=True, log_interval=1)
    supervision.assess()
    envs.close()
    print(folder.policy)


def make(args: Args, envs: VecEnv) -> PPO:
    model = PPO(
        "MlpPolicy",
        envs,
        learning_rate=args.learning_rate,
        n_steps=args.batch // args.envs,
        batch_size=128,
        n_epochs=args.epochs,
        gamma=args.discount,
        gae_lambda=0.95,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": math.log(args.spread)},
        tensorboard_log=str(Path(args.out) / "tensorboard"),
        seed=args.seed,
        device="cpu",
    )
    with torch.no_grad():
        # A wider draw here than of the gripper's way: to close at random is to succeed now and then.
        model.policy.log_std[-1] = math.log(args.gripper_spread)
    return model


if __name__ == "__main__":
    main(tyro.cli(Args))
