"""Training run of a network by imitation: folder, checkpoint, logs, and choice of the best network."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.learning.networks.weights import SavedNetwork, write_network_weights
from handover_marl.learning.training.run_folder import (
    CHECKPOINT,
    OUTCOMES,
    describe_origin,
    open_run_folder,
    read_checkpoint,
    summarize_evaluation,
    write_checkpoint,
)
from handover_marl.learning.training.scene_arguments import DatasetArgs

_LATEST = "latest.npz"


@dataclass(frozen=True)
class ImitationArgs(DatasetArgs):
    """Arguments of the trainings of receivers' networks by imitation.

    Attributes:
        out: Folder of the run.
        seed: Seed of all random numbers.
        rounds: Number of rounds in which the network acts (DAgger), evenly spread over the training.
        updates: Total number of gradient updates.
        val_scenes: Number of validation scenes, evenly chosen.
        workers: Number of worker processes; default: one per core.
        resume: Whether to continue the run in the folder `out`.
    """

    out: str = "runs/imitation"
    seed: int = 0
    rounds: int = 2
    updates: int = 12_000
    val_scenes: int = 36
    workers: int | None = None
    resume: bool = False

    @property
    def update_counts(self) -> list[int]:
        """Number of updates at the end of the first round and of each round in which the network acts."""
        counts: list[int] = np.linspace(0, self.updates, self.rounds + 2).round().astype(int)[1:].tolist()
        return counts


class ImitationRun:
    """Training run of the network of a receiver.

    Args:
        args: Arguments of the training.
        receiver: Name of the receiver; its script is `train_RECEIVER.py`, and the best network `RECEIVER.npz`.
        setup: Setup whose validation split selects the network.
        robot: Robot model of evaluations: panda or panda_camera.
        get_state: Function that returns the state of the training, a dict of tensors and numbers.
        restore: Function that restores such a state.
        free: Names of arguments that may change when a run is resumed.

    Attributes:
        folder: Folder of the run.
        writer: Writer of the TensorBoard logs.

    Raises:
        ResultsError: The folder contains another run, or one that must not be resumed.
    """

    def __init__(
        self,
        args: ImitationArgs,
        receiver: str,
        setup: str | None,
        robot: str,
        get_state: Callable[[], dict[str, Any]],
        restore: Callable[[dict[str, Any]], None],
        free: Sequence[str] = (),
    ) -> None:
        data = args.open_dataset(robot)
        self.folder = open_run_folder(Path(args.out), args, args.resume, data.name, ("workers", *free))
        self._receiver, self._get_state, self._best = receiver, get_state, -1.0
        self._card = {"made by": describe_origin(f"train_{receiver}", args), "dataset": data.name}
        scenes = select_scenes_evenly(data.list_scenes(setup, "val"), args.val_scenes)
        self._config = EvaluationConfig(
            setup, "val", scenes, args.dataset, args.data_dir, "fast", robot=robot, receiver=receiver
        )
        self._execution = ExecutionConfig(args.workers, progress=False)
        if args.resume and (self.folder / CHECKPOINT).exists():

            def restore_all(state: dict[str, Any]) -> None:
                restore(state["training"])
                self._best = float(state["best"])

            read_checkpoint(self.folder / CHECKPOINT, restore_all)
        self.writer = SummaryWriter(str(self.folder / "tensorboard"))

    @property
    def latest(self) -> Path:
        """Weights of the last evaluation, with which the receiver acts in the next round."""
        return self.folder / _LATEST

    @property
    def best(self) -> Path:
        """Weights of the network with the largest mean success rate on the validation split."""
        return self.folder / f"{self._receiver}.npz"

    def save(self) -> None:
        """Write a checkpoint."""
        write_checkpoint(self.folder / CHECKPOINT, {"training": self._get_state(), "best": self._best})

    def evaluate(self, network: SavedNetwork, steps: int, options: Sequence[Mapping[str, object]] = ({},)) -> None:
        """Evaluate the network on the validation split, keep it if it is the best so far, and write a checkpoint.

        Args:
            network: Network of the receiver.
            steps: Number of gradient updates so far.
            options: Further options of the receiver in each evaluation.
        """
        write_network_weights(self.latest, network, {**self._card, "steps": steps})
        successes = []
        for chosen in options:
            receiver = (self._receiver, {"weights": str(self.latest), **chosen})
            report = evaluate_pair(replace(self._config, receiver=receiver), execution=self._execution)
            label = "".join(f", {name} {value}" for name, value in chosen.items())
            print(summarize_evaluation(report, f"{steps} gradient updates{label}"), flush=True)
            for name in OUTCOMES:
                self.writer.add_scalar(f"evaluation/{name}{label}", getattr(report, f"{name}_rate"), steps)
            successes.append(report.success_rate)
        if float(np.mean(successes)) >= self._best:
            self._best = float(np.mean(successes))
            shutil.copyfile(self.latest, self.best)
        self.save()
