"""Training of one agent with Stable-Baselines3's PPO. The module needs the extra `train`."""

import json
import math
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format
from stable_baselines3.common.vec_env import VecMonitor

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.custom_rewards import set_discount
from handover_marl.envs.vector.vector_env import vector_env
from handover_marl.envs.wrappers.wrapper import RETURN_PREFIX, EpisodeReturns
from handover_marl.errors import OptionError
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.execution.options import count_available_cores
from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3
from handover_marl.learning.custom_encodings import is_reference
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.learning.training.batch_vec_env import BatchVecEnv
from handover_marl.learning.training.run_folder import (
    POLICY,
    describe_origin,
    open_run_folder,
    select_training_scenes,
    spawn_seeds,
    summarize_evaluation,
)
from handover_marl.learning.training.scene_arguments import RlArgs
from handover_marl.simulation.engines import MUJOCO

_CHECKPOINT = "checkpoint.zip"


@dataclass(frozen=True)
class PpoArgs(RlArgs):
    """Arguments of the scripts that train one agent with Stable-Baselines3's PPO.

    Attributes:
        out: Folder of the run.
        features: Name of the features that the learning agent observes, or module:name of user-defined features.
        actions: Name of the learning agent's action scheme, or module:name of a user-defined scheme.
        rewards: Reward: sparse, shaped, or module:name of a user-defined reward.
        num_envs: Number of environments simulated in parallel; 0 means 64 with mujoco, else 8.
        minutes: Largest wall-clock time (min).
        eval_interval: Number of decisions between evaluations.
        eval_start: Whether to evaluate before the training, too.
        resume: Whether to continue the run in the folder `out`.
    """

    out: str = "runs/training"
    features: str = "close"
    actions: str = "grasp_servo"
    rewards: str = "sparse"
    num_envs: int = 0
    minutes: float = 30.0
    eval_interval: int = 8_192
    eval_start: bool = True
    resume: bool = False

    def __post_init__(self) -> None:
        # `module:name` may be in the working folder, which Python does not search when it runs a script.
        folder = str(Path.cwd())
        if folder not in sys.path and any(is_reference(value) for value in vars(self).values()):
            sys.path.append(folder)
        if self.batch_size < self.resolved_num_envs:
            raise OptionError(
                f"batch_size must be at least the number of environments, {self.resolved_num_envs}, got "
                f"{self.batch_size}; choose fewer with num_envs"
            )

    @property
    def resolved_num_envs(self) -> int:
        """Number of environments simulated in parallel, where `num_envs` may be 0."""
        return self.num_envs or (64 if self.physics == MUJOCO else 8)

    def make_env_config(self) -> EnvConfig:
        """Create the configuration of the environment on the training scenes."""
        return EnvConfig(
            **self.env_options,
            rewards=set_discount(self.rewards, self.discount),
            scenes=select_training_scenes(self.open_dataset().list_scenes(self.setup, "train")),
        )


def train_agent(args: PpoArgs, script: str, agent: str, partner: str, prepare: Callable[[PPO], None]) -> Path:
    """Train one agent by PPO with a frozen partner, from a checkpoint if `args.resume` is set and there is one.

    The folder `args.out` gets `policy.npz`, a checkpoint, TensorBoard logs, and the same values in `progress.csv`.

    Args:
        args: Arguments of the training.
        script: Name of the training script, which the policy file records.
        agent: Agent that learns, "giver" or "receiver".
        partner: Name of the other agent's policy.
        prepare: Function that initializes the model of a new run, before the first evaluation.

    Returns:
        Path of the policy file.
    """
    torch.set_num_threads(1)
    args = args.resolve_setup()
    # Both check arguments, so that the folder is made only for a run that can start.
    model, envs = _make_ppo(args, agent, partner)
    callback = EvaluationCallback(args, script, agent, partner)
    folder = open_run_folder(Path(args.out), args, args.resume, args.open_dataset().name)
    checkpoint = folder / _CHECKPOINT
    if args.resume and checkpoint.exists():
        # Without the pickled Python objects in the file, which `PPO.load` reads.
        model.set_parameters(str(checkpoint), device="cpu")
        with zipfile.ZipFile(checkpoint) as archive:
            model.num_timesteps = json.loads(archive.read("data"))["num_timesteps"]
        # Other episodes than those before the interruption.
        envs.seed(spawn_seeds(1, args.seed, model.num_timesteps)[0])
    else:
        prepare(model)
    suffix = f"_{model.num_timesteps}" if model.num_timesteps else ""
    formats = [make_output_format("csv", str(folder), suffix)]
    model.set_logger(Logger(str(folder), [*formats, make_output_format("tensorboard", str(folder / "tensorboard"))]))
    remaining = max(0, args.decisions - model.num_timesteps)
    model.learn(remaining, callback, reset_num_timesteps=False, progress_bar=True, log_interval=1)
    callback.evaluate()
    envs.close()
    return folder / POLICY


def _make_ppo(args: PpoArgs, agent: str, partner: str) -> tuple[PPO, VecMonitor]:
    """Make an untrained model of `agent` and its environments, which are seeded and run in one process per core."""
    envs = vector_env(
        args.resolved_num_envs,
        agent,
        partner,
        features=args.features,
        action_scheme=args.actions,
        wrappers=[EpisodeReturns],
        autoreset="same_step",
        processes=min(args.resolved_num_envs, count_available_cores()),
        config=args.make_env_config(),
    )
    monitored = VecMonitor(BatchVecEnv(envs))
    monitored.seed(args.seed)
    model = PPO(
        "MlpPolicy",
        monitored,
        learning_rate=args.learning_rate,
        n_steps=args.batch_size // args.resolved_num_envs,
        batch_size=args.minibatch_size,
        n_epochs=args.epochs,
        gamma=args.discount,
        gae_lambda=args.gae_lambda,
        clip_range=args.clip_range,
        policy_kwargs={"net_arch": [args.width] * 2, "log_std_init": math.log(args.initial_std)},
        seed=args.seed,
        device="cpu",
    )
    return model, monitored


class EvaluationCallback(BaseCallback):
    """Callback that logs reward terms, evaluates the policy, writes checkpoints and stops when time is up.

    Evaluations happen between rollouts, every `args.eval_interval` decisions. A resumed run has new environments with
    seeds of their own, so that its episodes differ from those of a run without an interruption.

    Args:
        args: Arguments of the training, with a setup.
        script: Name of the training script.
        agent: Agent that learns.
        partner: Name of the other agent's policy.
    """

    def __init__(self, args: PpoArgs, script: str, agent: str, partner: str) -> None:
        super().__init__()
        (other,) = set(AGENTS) - {agent}
        self._args, self._folder, self._next = args, Path(args.out), 0
        self._spec = PolicySpec(agent, args.features, args.actions, args.control_period, describe_origin(script, args))
        val = select_scenes_evenly(args.open_dataset().list_scenes(args.setup, "val"), args.val_scenes)
        where = (args.setup, "val", val, args.dataset, args.data_dir, args.physics)
        policies: dict[str, Any] = {agent: f"learned:{self._folder / POLICY}", other: partner}
        self._config = EvaluationConfig(*where, **policies)
        # User-defined features and schemes were named by the caller, so they may be imported.
        trust = is_reference(args.features) or is_reference(args.actions)
        self._execution, self._started = ExecutionConfig(progress=False, trust=trust), time.monotonic()

    def _on_training_start(self) -> None:
        self._next = self.num_timesteps + self._args.eval_interval
        if self._args.eval_start and not self.num_timesteps:
            self.evaluate()

    def _on_step(self) -> bool:
        for info, is_last in zip(self.locals["infos"], self.locals["dones"], strict=True):
            for key, value in info.items() if is_last else ():
                if key.startswith(RETURN_PREFIX):
                    self.logger.record_mean(f"rewards/{key[len(RETURN_PREFIX) :]}", float(value))
        return time.monotonic() - self._started < 60.0 * self._args.minutes

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self._next = self.num_timesteps + self._args.eval_interval
            self.evaluate()

    def evaluate(self) -> None:
        """Write the policy file, evaluate it on validation scenes, log and print the outcomes, write a checkpoint."""
        write_policy(self._folder / POLICY, self._spec, dense_network_from_sb3(self.model))
        report = evaluate_pair(self._config, execution=self._execution)
        for name, rate in report.rates.items():
            self.logger.record(f"evaluation/{name}", rate.mean)
        self.logger.dump(self.num_timesteps)
        print(summarize_evaluation(report, f"{self.num_timesteps} decisions"), flush=True)
        part = self._folder / f"part_{_CHECKPOINT}"
        self.model.save(part)
        part.replace(self._folder / _CHECKPOINT)
