"""What the training scripts with Stable-Baselines3's PPO share: arguments, environments, and the run itself."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import handover_marl
from handover_marl.benchmarking.report import Report
from handover_marl.datasets import open_dataset
from handover_marl.envs.constructors import EnvOptions, parallel_env
from handover_marl.envs.encode import EncodedEnv, encode
from handover_marl.envs.freeze import freeze
from handover_marl.envs.vector_env import HandoverVectorEnv
from handover_marl.envs.wrapper import SingleAgentEnv
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.run import Run
from handover_marl.sim.engines import MUJOCO
from handover_marl.training.run_folder import (
    RunFolder,
    evaluate_policy,
    origin,
    spread_scenes,
)
from handover_marl.training.stable_baselines import Supervision, batched_env, load_checkpoint, vector_env
from handover_marl.training.training_args import TrainingArgs


@dataclass(frozen=True)
class PpoArgs(TrainingArgs):
    """What to train, and how.

    Attributes:
        observe: Name of the features.
        actions: Name of the action scheme.
        batch: Decisions between updates.
        width: Units in each of two hidden layers.
        every: Decisions between evaluations.
        envs: Environments; 0 is 64 where they are simulated in batches, else 8.
    """

    observe: str = "receiver"
    actions: str = "cartesian_delta"
    batch: int = 2048
    width: int = 64
    every: int = 8_192
    envs: int = 0

    @property
    def n_envs(self) -> int:
        """Environments."""
        return self.envs or (64 if self.physics == MUJOCO else 8)


def encoded_env(args: PpoArgs, agent: str, partner: str, options: EnvOptions) -> EncodedEnv:
    """One agent's environment as it trains in it."""
    live = freeze(parallel_env(**options), agent, partner)
    return encode(live, args.observe, args.actions)


def train_ppo(
    args: PpoArgs,
    agent: str,
    partner: str,
    script: str,
    prepare: Callable[[PPO, Callable[[], EncodedEnv]], None] = lambda model, make: None,
) -> Path:
    """Train one agent with its partner frozen; returns the policy's file.

    Args:
        args: What and how.
        agent: "giver" or "receiver".
        partner: Name of the other one's policy.
        script: Name of the script, for the policy's file.
        prepare: What to do with a new model before training; gets what makes an environment, too.
    """
    torch.set_num_threads(1)
    data = open_dataset(args.dataset, args.data_dir)
    folder = RunFolder(Path(args.out), args, args.resume, data.name)
    val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
    options = args.env_options()
    make = functools.partial(encoded_env, args, agent, partner, options)
    if args.physics == MUJOCO:
        envs = batched_env(args.n_envs, args.seed, functools.partial(_batch, args, agent, partner, options))
    else:
        envs = vector_env(args.n_envs, args.seed, functools.partial(_gymnasium, make))
    model = make_model(args, envs)
    if args.resume and folder.checkpoint.exists():
        load_checkpoint(model, folder.checkpoint)
        folder.forget_after(model.num_timesteps)
    else:
        prepare(model, make)

    run = Run(args.setup, "val", val, args.dataset, args.data_dir, args.physics)

    def evaluate(policy: Path) -> Report:
        return evaluate_policy(agent, policy, partner, run)

    spec = PolicySpec(agent, args.observe, args.actions, args.control_period, origin(script, args))
    supervision = Supervision(folder, spec, evaluate, args.every, args.minutes, partner)
    left = max(0, args.steps - model.num_timesteps)
    model.learn(left, supervision, reset_num_timesteps=False, progress_bar=True, log_interval=1)
    supervision.assess()
    envs.close()
    return folder.policy


def make_model(args: PpoArgs, envs: VecEnv) -> PPO:
    """A new model."""
    return PPO(
        "MlpPolicy",
        envs,
        learning_rate=args.learning_rate,
        n_steps=args.batch // args.n_envs,
        batch_size=128,
        n_epochs=args.epochs,
        gamma=args.discount,
        gae_lambda=args.trace,
        policy_kwargs={"net_arch": [args.width] * 2, "log_std_init": math.log(args.spread)},
        tensorboard_log=str(Path(args.out) / "tensorboard"),
        seed=args.seed,
        device="cpu",
    )


def _batch(args: PpoArgs, agent: str, partner: str, options: EnvOptions, count: int) -> HandoverVectorEnv:
    return handover_marl.vector_env(
        count,
        agent,
        partner,
        features=args.observe,
        schemes=args.actions,
        autoreset="same_step",
        threads=1,
        **options,
    )


def _gymnasium(make: Callable[[], EncodedEnv]) -> SingleAgentEnv:
    return SingleAgentEnv(make())
