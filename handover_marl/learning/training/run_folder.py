"""Run folder, checkpoint, seeds, validation and networks of trainings. The module needs the extra `train`."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import ResultsError
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.reports.report import Report
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import check_archive, read_plain_file
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.policy_files import DenseNetwork, InputNormalization
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.policies.reference import PolicyLike

POLICY, CHECKPOINT = "policy.npz", "checkpoint.pt"
_FAILURES = ("contact", "drop", "timeout")
_ARGUMENTS = "arguments.json"
# Largest absolute value of normalized inputs.
_INPUT_CLIP = 5.0
_MAX_CHECKPOINT_BYTES = 20_000_000_000
# Arguments that may change when a run is resumed: durations and paths.
_MUTABLE_ARGS = ("resume", "out", "data_dir", "decisions", "minutes")
# Arguments that the description of a policy's training omits.
_UNRECORDED_ARGUMENTS = ("out", "data_dir", "resume")


def spawn_seeds(count: int, *entropy: int) -> list[int]:
    """Return `count` 32-bit seeds derived from the integers `entropy`, e.g. the seed of a training.

    Different integers below 2^32 give unrelated seeds, unless they differ only by zeros at the end.
    """
    return [int(seed) for seed in np.random.SeedSequence(entropy).generate_state(count)]


def describe_origin(script: str, arguments: object, *omitted: str) -> str:
    """Return "experiments/training/SCRIPT.py name=value, ..." without out, data_dir, resume and the names `omitted`."""
    left_out = (*_UNRECORDED_ARGUMENTS, *omitted)
    parts = [f"{key}={value!r}" for key, value in vars(arguments).items() if key not in left_out]
    return f"experiments/training/{script}.py {', '.join(parts)}"


def open_run_folder(
    path: Path, args: object, resume: bool, dataset: str, mutable_args: Sequence[str] = (), **hashes: str
) -> Path:
    """Make the folder of a training run, write the run's arguments to it, and return its path.

    Args:
        path: Path of the folder.
        args: Dataclass of the run's arguments. To resume, all but durations and paths (`_MUTABLE_ARGS`) must be equal.
        resume: Whether to continue the run in the folder. `ResultsError` is raised if the folder has no run or one with
            other arguments, and, without `resume`, if it has a run.
        dataset: Name of the dataset, to which "auto" was resolved.
        mutable_args: Names of further arguments that may change when a run is resumed.
        hashes: Hashes of policies and files that the arguments name, by name; they must be the same, too.
    """
    recorded = {key: value for key, value in vars(args).items() if key not in (*_MUTABLE_ARGS, *mutable_args)}
    text = json.dumps(recorded | {"dataset": dataset} | hashes, indent=1, default=repr)
    file = path / _ARGUMENTS
    if resume and not file.exists():
        raise ResultsError(f"{path} holds no run to continue; leave out --resume, or pass the run's folder as --out")
    if file.exists():
        if not resume:
            raise ResultsError(f"{path} holds a run; pass --resume to continue it, or another --out")
        try:
            found = dict(json.loads(read_plain_file(file)))
        except (OSError, ValueError, TypeError) as error:
            raise ResultsError(f"{file}: not the arguments of a run ({error}); choose another --out") from error
        expected = json.loads(text)
        different = [key for key in found.keys() | expected.keys() if found.get(key) != expected.get(key)]
        if different:
            raise ResultsError(
                f"{path} holds a run with other arguments ({', '.join(sorted(different))}); use them again or choose "
                "another --out"
            )
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ResultsError(f"cannot make {path}: {error}") from error
    write_atomically(file, text)
    return path


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint file with a dict of tensors and numbers; an interruption leaves the previous file intact."""
    temporary = path.with_suffix(".part")
    torch.save(state, temporary)
    temporary.replace(path)


def read_checkpoint(path: Path, restore: Callable[[dict[str, Any]], None]) -> None:
    """Read a file of `write_checkpoint`, without running code in it, and call `restore` with the dict in it.

    Raises ResultsError if reading or `restore` fails.
    """
    try:
        check_archive(path, _MAX_CHECKPOINT_BYTES)
        restore(torch.load(path, weights_only=True))
    except Exception as error:  # Damaged files raise exceptions of many types.
        raise ResultsError(
            f"{path}: not a checkpoint of this run ({shorten_text(error)}); remove it to start anew"
        ) from error


def validate(
    args: SetupArgs, count: int, giver: PolicyLike, receiver: PolicyLike, label: str, **options: Any
) -> Report:
    """Evaluate giver and receiver on evenly chosen validation scenes; print a line of outcomes; return the report.

    Args:
        args: Dataset and setup.
        count: Number of scenes.
        giver: Giver, with options.
        receiver: Receiver, with options.
        label: Text at the start of the line, such as the number of training steps.
        options: Other options of `handover_marl.evaluate_pair`, such as the physics.
    """
    scenes = select_scenes_evenly(args.open_dataset().list_scenes(args.setup, "val"), count)
    where = {"scenes": scenes, "dataset": args.dataset, "data_dir": args.data_dir, "progress": False}
    report = evaluate_pair(giver, receiver, args.setup, "val", **where | options)
    success, metadata = report.rates["success"].format(), report.metadata
    others = ", ".join(f"{name} {100 * (report.rates[name].mean or 0.0):.1f} %" for name in _FAILURES)
    what = f"[{len(report.episodes)} scenes of {metadata.dataset}, {metadata.physics} physics]"
    print(f"{label}: success {success} %, {others} {what}", flush=True)
    return report


def fit_network(
    network: nn.Sequential,
    activation: str,
    inputs: torch.Tensor,
    batches: Sequence[torch.Tensor],
    compute_loss: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
    learning_rate: float,
    weight_decay: float,
) -> DenseNetwork:
    """Train a network on normalized inputs by AdamW with cosine decay to zero; return it as a `DenseNetwork`.

    Args:
        network: New network of linear layers on the CPU, trained in place.
        activation: Activation between the layers, a key of `ACTIVATIONS`.
        inputs: Inputs (n, k) of all samples; their mean and deviation are the normalization.
        batches: Indices (b,) of the samples in each gradient step.
        compute_loss: Function from the outputs (b, m) of the network and the indices (b,) of their samples to a loss.
        learning_rate: Learning rate at the start.
        weight_decay: Weight decay.
    """
    mean, scale = inputs.mean(0), inputs.std(0).clamp(min=0.05)
    normalized = ((inputs - mean) / scale).clamp(-_INPUT_CLIP, _INPUT_CLIP)
    optimizer = torch.optim.AdamW(network.parameters(), learning_rate, weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, len(batches))
    for rows in batches:
        loss = compute_loss(network(normalized[rows]), rows)
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.step()
        schedule.step()
    clip = np.full(inputs.shape[1], _INPUT_CLIP)
    normalization = InputNormalization(mean.double().numpy(), scale.double().numpy(), clip)
    return replace(dense_network_from_layers(network, activation), normalization=normalization)


def make_mlp(n_inputs: int, n_outputs: int, width: int = 64, gain: float = 1.0) -> nn.Sequential:
    """Make a network with two hidden tanh layers of the given width, with orthogonal initialization.

    The initial weights of the last layer are scaled by `gain`; a small one makes the first outputs nearly zero.
    """
    layers = [nn.Linear(n_inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, n_outputs)]
    for layer in layers:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else np.sqrt(2.0))
            nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)
