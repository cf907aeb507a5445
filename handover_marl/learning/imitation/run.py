"""Training of networks by imitation: samples in files, optimizer, averaged weights, and choice of the best network.

Samples are a named tuple of arrays (n, ...), generated in parallel processes. A file has the samples of one key, a
number such as that of a scene. Files do not depend on the number of processes, and an interrupted generation can be
resumed.
"""

import math
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import track
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.tensorboard import SummaryWriter

from handover_marl.errors import DataNotFoundError, ResultsError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.execution.reading import read_arrays
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

_MAX_BYTES = 1_000_000_000

#: Named tuple of arrays.
Samples = TypeVar("Samples", bound=tuple[npt.NDArray[Any], ...])


def generate_samples(
    kind: type[Samples],
    folder: Path,
    keys: Sequence[int],
    make_generator: Callable[[], Callable[[int], Samples]],
    description: str,
    workers: int | None,
) -> list[Samples]:
    """Return the samples of each key, in the order of `keys`; first generate, and write, those that have no file.

    Args:
        kind: Class of the samples, a named tuple of arrays.
        folder: Folder of the files; it must not have files of another configuration.
        keys: Numbers that name the files, such as scene numbers.
        make_generator: Factory of a function from a key to its samples; called once in every process.
        description: Label of the progress bar.
        workers: Number of worker processes; default: one per core.
    """
    folder.mkdir(parents=True, exist_ok=True)

    def make_writer() -> Callable[[int], None]:
        generate: Callable[[int], Any] = make_generator()
        return lambda key: write_arrays(get_samples_path(folder, key), generate(key)._asdict())

    missing = [key for key in keys if not get_samples_path(folder, key).exists()]
    if missing:
        for _ in map_with_progress(make_writer, missing, description, PoolConfig(workers), progress=True):
            pass
    return [read_samples(kind, get_samples_path(folder, key)) for key in keys]


def get_samples_path(folder: Path, key: int) -> Path:
    """Return the path of the file in a folder for the samples of a key, such as a scene number."""
    return folder / f"{key:06d}.npz"


def read_samples(kind: type[Samples], path: Path) -> Samples:
    """Read the samples in a file (.npz) as a named tuple of the class `kind`; raise ResultsError if that fails."""
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    try:
        return kind(*read_arrays(path, names, _MAX_BYTES).values())
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise ResultsError(f"{path}: not a file of samples ({shorten_text(error)}); remove it and resume") from error


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Concatenate samples, named tuples of arrays (n, ...), in the given order; raise DataNotFoundError for none."""
    if not parts:
        raise DataNotFoundError("a training needs samples, got none; pass at least two scenes")
    return type(parts[0])(*map(np.concatenate, zip(*parts, strict=True)))


def stack_samples(
    kind: type[Samples], rows: Sequence[tuple[Any, ...]], columns: Sequence[tuple[npt.DTypeLike, tuple[int, ...]]]
) -> Samples:
    """Return samples as a named tuple of arrays (n, ...), from a list with the values of each of the n samples.

    Args:
        kind: Class of the samples, a named tuple of arrays.
        rows: Values of each sample, one for each field of `kind`; there may be no rows.
        columns: Data type and shape of one value for each field of `kind`.
    """
    values = zip(*rows, strict=True) if rows else [()] * len(columns)
    return kind(
        *(
            np.array(column, dtype=dtype).reshape(len(rows), *shape)
            for column, (dtype, shape) in zip(values, columns, strict=True)
        )
    )


Network = TypeVar("Network", bound=nn.Module)
Batch = TypeVar("Batch")
_WEIGHT_DECAY = 1e-4
# Updates between two records of losses, and between two evaluations on held-out samples with a checkpoint.
LOSS_INTERVAL, METRICS_INTERVAL = 50, 500


class Batches(ABC):
    """Data set of n samples, given as a sequence of arrays or tensors (n, ...), from which random batches are drawn."""

    def __init__(self, samples: Sequence[Any]) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples[0])

    @abstractmethod
    def sample(self, count: int, rng: np.random.Generator) -> Any:
        """Return a batch of `count` randomly drawn and augmented samples."""


class ImitationLearner(ABC, Generic[Network, Batch]):
    """Base class of trainers of a network by AdamW, with an exponential average of the weights.

    Args:
        network: Network to train.
        updates: Number of updates of the whole training, over which the learning rate decays.
        device: Device to train on.

    Attributes:
        learning_rate: Largest learning rate of AdamW.
        final_share: Learning rate at the end of its cosine decay, as fraction of the largest.
        warmup: Number of updates at the start in which the learning rate rises linearly.
        epsilon: Number that AdamW adds to denominators.
        max_gradient_norm: Largest norm of the gradient; longer gradients are scaled down.
        averaging: Decay of the exponential average of the weights; with 0 the weights are not averaged.
        use_bfloat16: Whether matrix products are computed in bfloat16; False on CPUs without AVX-512, which emulate it.
        n_updates: Number of updates so far.
        averaged_network: Network with the averaged weights, for use after training.
    """

    learning_rate, final_share, warmup, epsilon = 1e-3, 0.0, 1, 1e-8
    max_gradient_norm, averaging, use_bfloat16 = 5.0, 0.0, True

    def __init__(self, network: Network, updates: int, device: torch.device) -> None:
        self.updates, self._device = updates, device
        self.use_bfloat16 &= device.type != "cpu" or torch.backends.cpu.get_cpu_capability().startswith("AVX512")
        self._network = network.to(device)
        self._averages = AveragedModel(self._network, avg_fn=self._average, use_buffers=True)
        self.averaged_network: Network = self._averages.module.eval()  # type: ignore[assignment]
        groups = [
            {"params": list(parameters), "rate": rate} for parameters, rate in self.list_parameter_groups(network)
        ]
        self._optimizer = torch.optim.AdamW(groups, lr=self.learning_rate, weight_decay=_WEIGHT_DECAY, eps=self.epsilon)
        self.n_updates = 0

    @abstractmethod
    def compute_losses(self, network: Network, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss to minimize, and losses to report by name, of a network on a batch on any device."""

    @abstractmethod
    def evaluate(self, held_out: Any) -> dict[str, float]:
        """Return metrics of the network with averaged weights on held-out samples, by name."""

    def list_parameter_groups(self, network: Network) -> list[tuple[Iterable[nn.Parameter], float]]:
        """Return groups of the network's parameters, each with its largest learning rate; by default one group."""
        return [(network.parameters(), self.learning_rate)]

    def update(self, batch: Batch) -> dict[str, float]:
        """Update the network by one gradient step on a batch; return the losses before the update, by name."""
        self._network.train()
        for group in self._optimizer.param_groups:
            group["lr"] = group["rate"] * self._compute_rate_share()
        loss, losses = self.compute_losses(self._network, batch)
        self._optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), self.max_gradient_norm)
        self._optimizer.step()
        self.n_updates += 1
        self._averages.update_parameters(self._network)
        return {name: float(value.detach()) for name, value in losses.items()}

    def get_state(self) -> dict[str, Any]:
        """Return a dict with weights, averaged weights, optimizer state and number of updates, for a checkpoint."""
        return {
            "done": self.n_updates,
            "network": self._network.state_dict(),
            "averaged": self._averages.state_dict(),
            "optimizer": self._optimizer.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore weights, averaged weights, optimizer state and number of updates from a result of `get_state`."""
        self._network.load_state_dict(state["network"])
        self._averages.load_state_dict(state["averaged"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.n_updates = int(state["done"])

    def _compute_rate_share(self) -> float:
        """Return the present learning rates as fraction of the largest ones."""
        rise = min(1.0, (self.n_updates + 1) / max(1, self.warmup))
        fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.n_updates / max(1, self.updates))))
        return rise * (self.final_share + (1.0 - self.final_share) * fall)

    def _average(self, averaged: Tensor, current: Tensor, _: Tensor | int) -> Tensor:
        """Return the new average of a parameter or buffer, from its last average and its present value."""
        # Averages over few updates at first, so that the initial weights are soon forgotten.
        decay = min(self.averaging, (1.0 + self.n_updates) / (10.0 + self.n_updates))
        return decay * averaged + (1.0 - decay) * current


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

    @property
    def torch_device(self) -> torch.device:
        """Device to train on; "auto" is a GPU if PyTorch finds one, else the processor."""
        automatic = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(automatic if self.device == "auto" else self.device)


class ImitationRun:
    """Training run of a receiver's network by imitation, in rounds; evaluations after them select the best network.

    Args:
        args: Arguments of the training; evaluations are on the validation split of `args.setup`.
        receiver: Name of the receiver; the script is `train_RECEIVER.py`, and the file of the best network
            `RECEIVER.npz`.
        robot: Robot model of evaluations: panda or panda_camera.
        learner: Trainer of the network.
        mutable_args: Names of arguments that may change when a run is resumed.

    Attributes:
        folder: Folder of the run.
        latest: Path of the weights of the last evaluated network, which acts in the next round.
        writer: Writer of the TensorBoard logs.
    """

    def __init__(
        self,
        args: ImitationArgs,
        receiver: str,
        robot: str,
        learner: ImitationLearner[Any, Any],
        mutable_args: Sequence[str] = (),
    ) -> None:
        data = args.open_dataset(robot)
        mutable_args = ("workers", "threads", "device", *mutable_args)
        self.folder = open_run_folder(Path(args.out), args, args.resume, data.name, mutable_args)
        self._args, self._receiver, self._robot, self._learner = args, receiver, robot, learner
        # Success rate of the best network, and number of updates of the last one that was evaluated.
        self._best_rate, self._n_evaluated = -1.0, 0
        self._card = {"made by": describe_origin(f"train_{receiver}", args, "workers"), "dataset": data.name}
        if args.resume and (self.folder / CHECKPOINT).exists():

            def restore_all(state: dict[str, Any]) -> None:
                learner.restore(state["training"])
                self._best_rate, self._n_evaluated = float(state["best"]), int(state.get("evaluated", 0))

            read_checkpoint(self.folder / CHECKPOINT, restore_all)
        self.latest, self._path = self.folder / "latest.npz", self.folder / f"{receiver}.npz"
        self.writer = SummaryWriter(str(self.folder / "tensorboard"))

    def save(self) -> None:
        """Write a checkpoint: the state of the learner and of the evaluations."""
        evaluations = {"best": self._best_rate, "evaluated": self._n_evaluated}
        write_checkpoint(self.folder / CHECKPOINT, {"training": self._learner.get_state(), **evaluations})

    def train(
        self,
        collect: Callable[[int], Samples],
        make_batches: Callable[[Samples], Batches],
        held_out: Any,
        options: Sequence[Mapping[str, object]] = ({},),
        rounds: int = 0,
    ) -> Path:
        """Train in round 0 and `rounds` further rounds, evaluate after each, and return the best network's file.

        The best network has the highest mean success rate. All rounds have the same number of updates.

        Args:
            collect: Function from the number of a round to new samples; from round 1 on, the network should act.
            make_batches: Function from the samples of all rounds so far to a data set of batches.
            held_out: Samples that the learner is not trained on, for its metrics.
            options: Options of the receiver in each evaluation; each round has one evaluation per element.
            rounds: Number of rounds after round 0.
        """
        samples: list[Samples] = []
        for number, end in enumerate(np.linspace(0, self._args.updates, rounds + 2).round().astype(int)[1:].tolist()):
            samples.append(collect(number))
            # A run may have been stopped between an update and its evaluation.
            if self._learner.n_updates < end:
                self._update(make_batches(join_samples(samples)), held_out, end)
            if self._n_evaluated < end:
                self._evaluate(options)
        self.writer.close()
        return self._path

    def _update(self, batches: Batches, held_out: Any, end: int) -> None:
        """Train until the update with number `end`; log losses and held-out metrics, and write checkpoints."""
        args, learner = self._args, self._learner
        torch.set_num_threads(args.threads)
        for number in track(range(learner.n_updates + 1, end + 1), description=f"updates up to {end}"):
            # Seeded by the number of the update, so that a resumed run continues exactly.
            batch = batches.sample(args.batch_size, np.random.default_rng((args.seed, learner.n_updates)))
            losses = learner.update(batch)
            if number % LOSS_INTERVAL == 0 or number == end:
                self._log("train", losses, number)
            if number % METRICS_INTERVAL == 0 or number == end:
                self._log("held_out", learner.evaluate(held_out), number)
                self.save()

    def _log(self, kind: str, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self.writer.add_scalar(f"{kind}/{name}", value, step)

    def _evaluate(self, options: Sequence[Mapping[str, object]]) -> None:
        """Evaluate the network once per element of `options`, keep it if it is the best, and write a checkpoint."""
        steps = self._learner.n_updates
        write_network_weights(self.latest, self._learner.averaged_network, {**self._card, "steps": steps})
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
        if float(np.mean(successes)) >= self._best_rate:
            self._best_rate = float(np.mean(successes))
            shutil.copyfile(self.latest, self._path)
        self._n_evaluated = steps
        self.save()
