"""Training of one agent with Stable-Baselines3's PPO. The module needs the extra `train`.

The module has functions for the training, its environments, policy files and checkpoints, and a
callback that evaluates the policy.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.wrappers.wrapper import SingleAgentEnv
from handover_marl.execution.options import count_available_cores
from handover_marl.learning.adapters.sb3_models import dense_network_from_sb3
from handover_marl.learning.training.arguments import PpoArgs
from handover_marl.learning.training.batch_vec_env import BatchVecEnv
from handover_marl.learning.training.environments import make_frozen_env_factory, make_frozen_vector_env
from handover_marl.learning.training.run_folder import read_checkpoint, write_checkpoint
from handover_marl.learning.training.training_run import TrainingRun
from handover_marl.simulation.engines import MUJOCO


def train_agent(args: PpoArgs, script: str, agent: str, partner: str, prepare: Callable[[PPO], None]) -> Path:
    """Train one agent for a frozen partner, from a checkpoint if `args.resume` is set and there is one.

    Args:
        args: Arguments of the training.
        script: Name of the training script, which the policy files record.
        agent: Agent that learns, "giver" or "receiver".
        partner: Name of the other agent's policy.
        prepare: Function that initializes the model of a new run, before the first evaluation.

    Returns:
        Path of the policy file.
    """
    torch.set_num_threads(1)
    (frozen_agent,) = set(AGENTS) - {agent}
    run = TrainingRun(args, script, {agent: (args.features, args.actions)}, {frozen_agent: partner})
    envs = make_vec_env(args, agent, partner)
    model = make_ppo(args, envs)
    if args.resume and run.folder.checkpoint.exists():
        load_checkpoint(model, run.folder.checkpoint)
        run.discard_points_after(model.num_timesteps)
    else:
        prepare(model)
    callback = EvaluationCallback(run, agent, args.eval_interval, args.eval_start)
    remaining = max(0, args.decisions - model.num_timesteps)
    model.learn(remaining, callback, reset_num_timesteps=False, progress_bar=True, log_interval=1)
    callback.evaluate()
    envs.close()
    return run.folder.policy


def make_vec_env(args: PpoArgs, agent: str, partner: str) -> VecEnv:
    """Make `args.resolved_num_envs` seeded environments of one learning agent.

    With MuJoCo each core simulates a batch of environments, otherwise each environment has a
    process of its own. Episodes do not depend on this.

    Args:
        args: Arguments of the training.
        agent: Agent that learns, "giver" or "receiver".
        partner: Name of the other agent's policy.
    """
    envs: VecEnv
    if args.physics == MUJOCO:
        envs = BatchVecEnv(make_frozen_vector_env(args, agent, partner, count_available_cores()))
    else:
        make = make_frozen_env_factory(args, agent, partner)
        envs = SubprocVecEnv([lambda: SingleAgentEnv(make())] * args.resolved_num_envs)
    envs = VecMonitor(envs)
    envs.seed(args.seed)
    return envs


def make_ppo(args: PpoArgs, envs: VecEnv) -> PPO:
    """Make an untrained PPO model of Stable-Baselines3."""
    return PPO(
        "MlpPolicy",
        envs,
        learning_rate=args.learning_rate,
        n_steps=args.batch_size // args.resolved_num_envs,
        batch_size=128,
        n_epochs=args.epochs,
        gamma=args.discount,
        gae_lambda=args.gae_lambda,
        policy_kwargs={"net_arch": [args.width] * 2, "log_std_init": math.log(args.initial_std)},
        tensorboard_log=str(Path(args.out) / "tensorboard"),
        seed=args.seed,
        device="cpu",
    )


def save_checkpoint(model: OnPolicyAlgorithm, path: Path) -> None:
    """Write a checkpoint of a PPO model, from which training can be resumed."""
    state = {
        "parameters": model.get_parameters(),
        "num_timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "random": torch.get_rng_state(),
    }
    write_checkpoint(path, state)


def load_checkpoint(model: OnPolicyAlgorithm, path: Path) -> None:
    """Restore the state of a PPO model from a checkpoint.

    Raises:
        ResultsError: The file is not a checkpoint of such a model.
    """

    def restore(state: dict[str, Any]) -> None:
        model.set_parameters(state["parameters"], exact_match=True)
        model.num_timesteps = int(state["num_timesteps"])
        model._n_updates = int(state["updates"])
        torch.set_rng_state(state["random"])

    read_checkpoint(path, restore)


class EvaluationCallback(BaseCallback):
    """Callback that logs reward terms, evaluates the policy, writes checkpoints and stops when time is up.

    Evaluations happen between rollouts. A resumed run has new environments with the seeds of its start, so that its
    episodes differ from those of a run without an interruption.

    Args:
        run: Training run with its folder and evaluations.
        agent: Agent that learns.
        interval: Number of decisions between evaluations.
        evaluates_at_start: Whether to evaluate before the training, too.
    """

    def __init__(self, run: TrainingRun, agent: str, interval: int, evaluates_at_start: bool = True) -> None:
        super().__init__()
        self._run, self._agent, self._interval, self._next = run, agent, interval, 0
        self._evaluates_at_start = evaluates_at_start

    def _on_training_start(self) -> None:
        self._next = self.num_timesteps + self._interval
        if self._evaluates_at_start and not self._run.folder.points:
            self.evaluate()

    def _on_step(self) -> bool:
        for info, is_last in zip(self.locals["infos"], self.locals["dones"], strict=True):
            if is_last:
                self._run.rewards.add_episode(self._agent, info)
        return not self._run.is_out_of_time

    def _on_rollout_end(self) -> None:
        for name, mean in self._run.rewards.write_point(self.num_timesteps).items():
            self.logger.record(f"rewards/{name}", mean)

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self._next = self.num_timesteps + self._interval
            self.evaluate()

    def evaluate(self) -> None:
        """Write the policy file, evaluate the policy and write a checkpoint."""
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise TypeError(f"model must be an on-policy algorithm, got {type(self.model).__name__}")
        network = dense_network_from_sb3(self.model)
        point = self._run.evaluate(self.num_timesteps, {self._agent: network})
        for name in ("success", "contact", "drop", "timeout"):
            self.logger.record(f"evaluation/{name}", getattr(point, name))
        self.logger.dump(self.num_timesteps)
        save_checkpoint(self.model, self._run.folder.checkpoint)
