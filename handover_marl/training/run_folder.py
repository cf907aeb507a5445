"""What the training scripts share: a run's folder, its checkpoints, and evaluation on scenes not trained on.

Needs the extras `train` and `plot`.
"""

import csv
import io
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.errors import OptionError, ResultsError
from handover_marl.files import write_atomically
from handover_marl.run import Execution, Run
from handover_marl.training.learning_curve import CurvePoint, draw_curve

POLICY, CHECKPOINT, CURVE = "policy.npz", "checkpoint.pt", "learning_curve"
_ARGUMENTS = "arguments.json"
#: Every tenth scene of a training split is kept for testing.
HELD_OUT = 10


def training_scenes(scene_ids: Sequence[int]) -> tuple[int, ...]:
    """The scenes of a training split to train on: all but every tenth."""
    return tuple(scene for number, scene in enumerate(scene_ids) if number % HELD_OUT)


def held_out_scenes(scene_ids: Sequence[int]) -> tuple[int, ...]:
    """Every tenth scene of a training split."""
    return tuple(scene_ids[::HELD_OUT])


def spread_scenes(scene_ids: Sequence[int], n: int) -> tuple[int, ...]:
    """At most n scenes, evenly over a split.

    Raises:
        OptionError: n is less than one.
    """
    if n < 1:
        raise OptionError(f"val_scenes={n}: at least one scene is needed")
    chosen = np.unique(np.linspace(0, len(scene_ids) - 1, min(n, len(scene_ids))).round().astype(int))
    return tuple(scene_ids[number] for number in chosen.tolist())


_UNTOLD = ("out", "data_dir", "shared_views", "resume", "workers")


def origin(script: str, arguments: object) -> str:
    """How a policy is made, for its file: the script and all arguments but places and what changes nothing."""
    parts = [f"{key}={value!r}" for key, value in vars(arguments).items() if key not in _UNTOLD]
    return f"experiments/{script}.py {', '.join(parts)}"


class RunFolder:
    """Where a training run keeps what it makes: arguments, checkpoint, policy, learning curve, TensorBoard logs.

    Args:
        path: The folder.
        arguments: What is run; a run goes on only under the same.
        resume: Whether to go on with the run that is there, if there is one; None where that cannot be done.
        dataset: Name of the dataset that it turned out to be on.

    Raises:
        ResultsError: There is another run, or one that was not to be resumed, or the folder cannot be made.
    """

    #: Arguments that may differ when a run goes on: how long, where the data are, on how many cores.
    FREE = ("resume", "out", "data_dir", "steps", "minutes")

    def __init__(self, path: Path, arguments: object, resume: bool | None, dataset: str) -> None:
        self.path = path
        kept = {key: value for key, value in vars(arguments).items() if key not in self.FREE}
        # "auto" may be one thing today and another tomorrow.
        kept["dataset"] = dataset
        try:
            path.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise ResultsError(f"cannot make {path}: {error}") from error
        known = path / _ARGUMENTS
        if known.exists():
            self._check(_read_arguments(known), json.loads(json.dumps(kept)), resume)
        write_atomically(known, json.dumps(kept, indent=1))
        self.points = self._read_curve() if resume else []

    def _check(self, found: dict[str, Any], wanted: dict[str, Any], resume: bool | None) -> None:
        if resume is None:
            raise ResultsError(f"{self.path} holds a run, which cannot be gone on with; choose another --out")
        if not resume:
            raise ResultsError(f"{self.path} holds a run; pass --resume to go on with it, or another --out")
        different = [key for key in found.keys() | wanted.keys() if found.get(key) != wanted.get(key)]
        if different:
            raise ResultsError(
                f"{self.path} holds a run with other arguments ({', '.join(sorted(different))}); use them again "
                "or choose another --out"
            )

    @property
    def policy(self) -> Path:
        """The exported policy."""
        return self.path / POLICY

    @property
    def checkpoint(self) -> Path:
        """What training goes on from."""
        return self.path / CHECKPOINT

    @property
    def seconds(self) -> float:
        """Training time up to the last evaluation (s)."""
        return self.points[-1].seconds if self.points else 0.0

    def forget_after(self, steps: int) -> None:
        """Drop evaluations beyond a checkpoint: the run was stopped between the two, and will make them again."""
        self.points = [point for point in self.points if point.steps <= steps]

    def add(self, point: CurvePoint) -> None:
        """Note an evaluation and draw the learning curve anew."""
        self.points.append(point)
        stream = io.StringIO()
        writer = csv.DictWriter(stream, [part.name for part in fields(CurvePoint)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(point) for point in self.points)
        write_atomically(self.path / f"{CURVE}.csv", stream.getvalue())
        write_atomically(self.path / f"{CURVE}.png", draw_curve(self.points))

    def _read_curve(self) -> list[CurvePoint]:
        path = self.path / f"{CURVE}.csv"
        if not path.exists():
            return []
        try:
            with path.open(newline="") as stream:
                reader = csv.DictReader(stream)
                if reader.fieldnames != [part.name for part in fields(CurvePoint)]:
                    raise ValueError(f"columns {reader.fieldnames}")
                return [_point(row) for row in reader]
        except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
            raise ResultsError(
                f"{path}: no learning curve of this library ({type(error).__name__}: {error}); remove it to go on "
                "without its points"
            ) from error


def _read_arguments(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict):
            raise TypeError("not a dict")
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ResultsError(f"{path}: no arguments of a run ({error}); choose another --out") from error
    return found


def _point(row: dict[str, str]) -> CurvePoint:
    words = {"dataset", "physics", "partner"}
    numbers = {key: int(row[key]) if key in ("steps", "episodes") else float(row[key]) for key in row.keys() - words}
    return CurvePoint(**numbers, **{key: row[key] for key in words})  # type: ignore[arg-type]


def evaluate_policy(agent: str, policy: str | os.PathLike[str], partner: str, run: Run) -> Report:
    """Play scenes with an exported policy and its frozen partner.

    Args:
        agent: Whose policy it is, "giver" or "receiver".
        policy: The file.
        partner: Name of the other one's policy.
        run: What is played; its policies do not count.
    """
    name = f"learned:{os.fspath(policy)}"
    giver, receiver = (name, partner) if agent == "giver" else (partner, name)
    return evaluate_run(replace(run, giver=giver, receiver=receiver), Execution(progress=False))
