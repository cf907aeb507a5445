"""Train a receiver from scratch with Stable-Baselines3's TD3, the giver frozen. Needs extras `train` and `plot`.

    python experiments/train_receiver_sb3.py --data-dir DIR --out runs/receiver

Learns when to close the gripper and how to come to a grasp better than straight along its axis
(`handover_marl.learning.receiver_schemes.GraspServo`), from the task's sparse reward and in fast physics, on nine
tenths of a training split, and looks at the validation split now and then. The folder gets `policy.npz`
(`--receivers learned:runs/receiver/policy.npz`), `learning_curve.csv` and `.png`, TensorBoard logs, and a
checkpoint: `--resume` goes on where a run was stopped.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import VecEnv

from handover_marl.datasets import open_dataset
from handover_marl.learning.policy import PolicySpec
from handover_marl.learning.stable_baselines import Supervision, load_checkpoint, vector_env
from handover_marl.learning.training import RunFolder, evaluate_policy, origin, spread_scenes, training_scenes


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
        warm_up: Decisions before the first update, made by noise about zero.
        batch: Decisions from memory in an update; there is one update for every decision.
        spread: Standard deviation of the noise on the outputs while warming up; later half of it.
        gripper_spread: That on the last one, which opens and closes the gripper; likewise.
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
    minutes: float = 25.0
    time_limit: float = 8.0
    envs: int = 8
    warm_up: int = 3_000
    batch: int = 256
    spread: float = 0.15
    gripper_spread: float = 0.6
    learning_rate: float = 7e-4
    discount: float = 0.95
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
        rewards=args.rewards,
        control_period=args.control_period,
        time_limit=args.time_limit,
        **common,
    )
    model = load_checkpoint(TD3, folder, envs) if args.resume and folder.checkpoint.exists() else make(args, envs)
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
    for until, updates, scale in ((min(args.warm_up, args.steps), 0, 1.0), (args.steps, args.envs, 0.5)):
        model.gradient_steps, model.action_noise = updates, noise(args, envs, scale)
        left = until - model.num_timesteps
        if left > 0:
            model.learn(left, supervision, reset_num_timesteps=False, progress_bar=True, log_interval=50)
    supervision.assess()
    envs.close()
    print(folder.policy)


def make(args: Args, envs: VecEnv) -> TD3:
    model = TD3(
        "MlpPolicy",
        envs,
        learning_rate=args.learning_rate,
        buffer_size=200_000,
        learning_starts=0,
        batch_size=args.batch,
        gamma=args.discount,
        tau=0.01,
        policy_kwargs={"net_arch": [128, 128]},
        tensorboard_log=str(Path(args.out) / "tensorboard"),
        seed=args.seed,
        device="cpu",
    )
    # Outputs begin near zero, so that the noise alone decides at first.
    last = model.actor.mu[-2]
    with torch.no_grad():
        last.weight.mul_(0.01)
        last.bias.zero_()
    model.actor_target.load_state_dict(model.actor.state_dict())
    return model


def noise(args: Args, envs: VecEnv, scale: float) -> VectorizedActionNoise:
    """Wider on the gripper: to close at random is to succeed now and then."""
    spread = np.full(envs.action_space.shape, args.spread)
    spread[-1] = args.gripper_spread
    spread *= scale
    return VectorizedActionNoise(NormalActionNoise(np.zeros_like(spread), spread), args.envs)


if __name__ == "__main__":
    main(tyro.cli(Args))
