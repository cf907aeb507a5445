"""Training run of a network by imitation: folder, checkpoint, logs, and choice of the best network."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track
from torch.utils.tensorboard import SummaryWriter

from handover_marl.errors import OptionError
from handover_marl.learning.imitation.learner import Batches, ImitationLearner
from handover_marl.learning.imitation.samples import Samples, join_samples
from handover_marl.learning.networks.weights import write_network_weights
from handover_marl.learning.training.run_folder import (
    CHECKPOINT,
    describe_origin,
    open_run_folder,
    read_checkpoint,
    validate,
    write_checkpoint,
)
from handover_marl.learning.training.scene_arguments import SetupArgs

_LATEST = "latest.npz"
# Updates between two records of losses, and between two evaluations on held-out samples with a checkpoint.
LOSS_INTERVAL, METRICS_INTERVAL = 50, 500


@dataclass(frozen=True)
class ImitationArgs(SetupArgs):
    """Arguments of the trainings of receivers' networks by imitation.

    Attributes:
        out: Folder of the run.
        seed: Seed of all random numbers.
        updates: Total number of gradient updates.
        batch_size: Number of samples per gradient update.
        val_scenes: Number of validation scenes, evenly chosen.
        workers: Number of worker processes; default: one per core.
        threads: Number of threads of PyTorch.
        device: PyTorch device: cpu, cuda, or auto.
        resume: Whether to continue the run in the folder `out`.
    """

    out: str = "runs/imitation"
    seed: int = 0
    updates: int = 12_000
    batch_size: int = 64
    val_scenes: int = 36
    workers: int | None = None
    threads: int = 2
    device: str = "auto"
    resume: bool = False

    def __post_init__(self) -> None:
        for name in ("updates", "batch_size", "threads"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def torch_device(self) -> torch.device:
        """Device to train on; "auto" is a GPU if PyTorch finds one, else the processor."""
        automatic = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(automatic if self.device == "auto" else self.device)


class ImitationRun:
    """Training run of a receiver's network by imitation, with evaluations that select the best network.

    Args:
        args: Arguments of the training, with a setup, whose validation split selects the network.
        receiver: Name of the receiver; its script is `train_RECEIVER.py`, and the best network `RECEIVER.npz`.
        robot: Robot model of evaluations: panda or panda_camera.
        learner: Trainer of the network.
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
        robot: str,
        learner: ImitationLearner[Any, Any],
        free: Sequence[str] = (),
    ) -> None:
        data = args.open_dataset(robot)
        free = ("workers", "threads", "device", *free)
        self.folder = open_run_folder(Path(args.out), args, args.resume, data.name, free)
        self._args, self._receiver, self._robot, self._learner, self._best = args, receiver, robot, learner, -1.0
        self._card = {"made by": describe_origin(f"train_{receiver}", args), "dataset": data.name}
        if args.resume and (self.folder / CHECKPOINT).exists():

            def restore_all(state: dict[str, Any]) -> None:
                learner.restore(state["training"])
                self._best = float(state["best"])

            read_checkpoint(self.folder / CHECKPOINT, restore_all)
        self.writer = SummaryWriter(str(self.folder / "tensorboard"))

    @property
    def latest(self) -> Path:
        """Path of the weights of the last evaluation, with which the network acts in the next round."""
        return self.folder / _LATEST

    @property
    def best(self) -> Path:
        """Path of the weights of the network with the largest mean success rate on the validation split."""
        return self.folder / f"{self._receiver}.npz"

    def save(self) -> None:
        """Write a checkpoint: the state of the learner and the best success rate so far."""
        write_checkpoint(self.folder / CHECKPOINT, {"training": self._learner.get_state(), "best": self._best})

    def train(
        self,
        collect: Callable[[int], Samples],
        make_batches: Callable[[Samples], Batches],
        held_out: Any,
        options: Sequence[Mapping[str, object]] = ({},),
        rounds: int = 0,
    ) -> Path:
        """Train in all rounds, and evaluate after each; return the path of the best network's weights.

        Args:
            collect: Function that returns the samples of a round by its number; after round 0, the network acts.
            make_batches: Function from the samples of all rounds so far to a data set of batches.
            held_out: Samples that the learner is not trained on, for its metrics.
            options: Options of the receiver in each evaluation; each round has one evaluation per element.
            rounds: Number of rounds in which the network acts, evenly spread over the training.
        """
        samples: list[Samples] = []
        for number, end in enumerate(np.linspace(0, self._args.updates, rounds + 2).round().astype(int)[1:].tolist()):
            samples.append(collect(number))
            if self._learner.done < end:
                self._update(make_batches(join_samples(samples)), held_out, end)
                self._evaluate(options)
        self.writer.close()
        return self.best

    def _update(self, batches: Batches, held_out: Any, end: int) -> None:
        """Train until the update with number `end`; log losses of the batches, and metrics on held-out samples."""
        args, learner = self._args, self._learner
        torch.set_num_threads(args.threads)
        for done in track(range(learner.done + 1, end + 1), description=f"updates up to {end}"):
            # Seeded by the number of the update, so that a resumed run continues exactly.
            batch = batches.sample(args.batch_size, np.random.default_rng((args.seed, learner.done)))
            losses = learner.update(batch)
            if done % LOSS_INTERVAL == 0 or done == end:
                self._log("train", losses, done)
            if done % METRICS_INTERVAL == 0 or done == end:
                self._log("held_out", learner.evaluate(held_out), done)
                self.save()

    def _log(self, kind: str, values: Mapping[str, float], done: int) -> None:
        for name, value in values.items():
            self.writer.add_scalar(f"{kind}/{name}", value, done)

    def _evaluate(self, options: Sequence[Mapping[str, object]]) -> None:
        """Evaluate the network with each of the options, keep it if it is the best so far, and write a checkpoint."""
        steps = self._learner.done
        write_network_weights(self.latest, self._learner.averaged, {**self._card, "steps": steps})
        successes = []
        args = self._args
        for chosen in options:
            receiver = (self._receiver, {"weights": str(self.latest), **chosen})
            label = "".join(f", {name} {value}" for name, value in chosen.items())
            where: dict[str, Any] = {"physics": "fast", "robot": self._robot, "workers": args.workers}
            report = validate(args, args.val_scenes, "replay", receiver, f"{steps} gradient updates{label}", **where)
            for name, rate in report.rates.items():
                self.writer.add_scalar(f"evaluation/{name}{label}", rate.mean, steps)
            successes.append(report.success_rate)
        if float(np.mean(successes)) >= self._best:
            self._best = float(np.mean(successes))
            shutil.copyfile(self.latest, self.best)
        self.save()
