"""Training with Stable-Baselines3: environments, export, checkpoints, evaluation. Needs the extra `train`."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor

from handover_marl.benchmarking.report import Report
from handover_marl.learning.foreign_policies import dense_network
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import PolicySpec
from handover_marl.options import available_cores
from handover_marl.training.batch_vec_env import BatchVecEnv, MakeBatch
from handover_marl.training.checkpoint import read_checkpoint, write_checkpoint
from handover_marl.training.learning_curve import CurvePoint
from handover_marl.training.run_folder import RunFolder


def vector_env(n: int, seed: int, make: Callable[[], gymnasium.Env[Any, Any]]) -> VecEnv:
    """Environments in n processes, seeded.

    Args:
        n: How many.
        seed: Of the first; every other has its own.
        make: Makes one; picklable.
    """
    envs = VecMonitor(SubprocVecEnv([make for _ in range(n)]))
    envs.seed(seed)
    return envs


def batched_env(n: int, seed: int, make: MakeBatch) -> VecEnv:
    """Environments in batches, one for each core, seeded; what they play is as in `vector_env`.

    Args:
        n: How many environments.
        seed: Of the first; every other has its own.
        make: Makes a batch of so many.
    """
    envs = VecMonitor(BatchVecEnv(n, available_cores(), make))
    envs.seed(seed)
    return envs


def export(model: BaseAlgorithm, spec: PolicySpec, path: Path) -> None:
    """Write a model's deterministic policy as a policy file (.npz).

    Raises:
        DataFormatError: It is not made of dense layers.
        ResultsError: The file cannot be written.
    """
    state = {name: value.detach().cpu().numpy() for name, value in model.policy.state_dict().items()}
    about = {"policy_kwargs": {key: str(value) for key, value in model.policy_kwargs.items()}}
    network, squashed = dense_network(state, about, "the trained policy")
    write_policy(path, spec, replace(network, output="tanh") if squashed else network)


def save_checkpoint(model: OnPolicyAlgorithm, path: Path) -> None:
    """Write what training goes on from."""
    state = {
        "parameters": model.get_parameters(),
        "num_timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "random": torch.get_rng_state(),
    }
    write_checkpoint(path, state)


def load_checkpoint(model: OnPolicyAlgorithm, path: Path) -> None:
    """Let a model that was just made go on from a checkpoint.

    Raises:
        ResultsError: It is no checkpoint of such a model.
    """

    def restore(state: dict[str, Any]) -> None:
        model.set_parameters(state["parameters"], exact_match=True)
        model.num_timesteps = int(state["num_timesteps"])
        model._n_updates = int(state["updates"])
        torch.set_rng_state(state["random"])

    read_checkpoint(path, restore)


class Supervision(BaseCallback):
    """Checkpoints, exports and evaluates now and then and at the end, and stops when the time is up.

    Args:
        folder: Where everything goes.
        spec: What the policy is.
        evaluate: Plays scenes with an exported policy.
        every: Decisions between evaluations.
        minutes: Wall-clock time after which to stop (min), evaluations counted.
        partner: Name of the other agent's policy.
    """

    def __init__(
        self,
        folder: RunFolder,
        spec: PolicySpec,
        evaluate: Callable[[Path], Report],
        every: int,
        minutes: float,
        partner: str,
    ) -> None:
        super().__init__()
        self._folder, self._spec, self._evaluate = folder, spec, evaluate
        self._every, self._limit, self._partner = every, 60.0 * minutes, partner
        self._before = folder.seconds
        self._started = time.monotonic()
        self._due = 0

    @property
    def supervised(self) -> OnPolicyAlgorithm:
        """The model that learns."""
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise TypeError("only on-policy methods are supervised")
        return self.model

    @property
    def seconds(self) -> float:
        """Wall-clock time of this run, earlier sessions included (s)."""
        return self._before + time.monotonic() - self._started

    def _on_training_start(self) -> None:
        self._due = self.num_timesteps + self._every
        if not self._folder.points:
            self.assess()

    def _on_step(self) -> bool:
        return self.seconds < self._limit

    # Between rollouts nothing is half done, so that a checkpoint goes on where training was.
    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._due:
            self._due = self.num_timesteps + self._every
            self.assess()

    def assess(self) -> None:
        """Export, evaluate, and save a checkpoint."""
        folder = self._folder
        export(self.model, self._spec, folder.policy)
        report = self._evaluate(folder.policy)
        point = CurvePoint.of(report, self.num_timesteps, self.seconds, self._partner)
        folder.add(point)
        for name in ("success", "contact", "drop", "timeout"):
            self.logger.record(f"evaluation/{name}", getattr(point, name))
        self.logger.dump(self.num_timesteps)
        save_checkpoint(self.supervised, self._folder.checkpoint)
