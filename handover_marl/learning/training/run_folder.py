"""Folder of a training run: arguments, checkpoint, policy, learning curve; and choice of scenes.

The module needs the extras `train` and `plot`.
"""

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch

from handover_marl.errors import ResultsError
from handover_marl.execution.files import shorten_text, write_atomically
from handover_marl.execution.reading import check_archive, read_plain_file
from handover_marl.learning.training.learning_curve import DECISIONS, CurvePoint, draw_curve

POLICY, CHECKPOINT, CURVE = "policy.npz", "checkpoint.pt", "learning_curve"
_ARGUMENTS = "arguments.json"
_MAX_CHECKPOINT_BYTES = 20_000_000_000
# Every tenth scene of a training split is held out.
_HELD_OUT = 10
# Arguments that the description of a policy's training omits: paths, and those without effect.
_UNRECORDED_ARGUMENTS = ("out", "data_dir", "shared_views", "resume", "workers")


def select_training_scenes(scene_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the scenes of a training split that are used for training: all but every tenth."""
    return tuple(scene for number, scene in enumerate(scene_ids) if number % _HELD_OUT)


def select_held_out_scenes(scene_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the held-out scenes of a training split: every tenth."""
    return tuple(scene_ids[::_HELD_OUT])


def describe_origin(script: str, arguments: object) -> str:
    """Return the script and the arguments of a training, for policy files."""
    parts = [f"{key}={value!r}" for key, value in vars(arguments).items() if key not in _UNRECORDED_ARGUMENTS]
    return f"experiments/training/{script}.py {', '.join(parts)}"


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint file; an interruption leaves the previous file intact.

    Args:
        path: File to write.
        state: Dict of tensors and numbers.
    """
    temporary = path.with_suffix(".part")
    torch.save(state, temporary)
    temporary.replace(path)


def read_checkpoint(path: Path, restore: Callable[[dict[str, Any]], None]) -> None:
    """Read a checkpoint and pass its state to a function; no code in the file is run.

    Args:
        path: File written by `write_checkpoint`.
        restore: Function that continues from the state, a dict of tensors and numbers.

    Raises:
        ResultsError: The file is damaged, or `restore` cannot use the state.
    """
    try:
        check_archive(path, _MAX_CHECKPOINT_BYTES)
        restore(torch.load(path, weights_only=True))
    except Exception as error:  # Damaged files raise exceptions of many types.
        raise ResultsError(
            f"{path}: not a checkpoint of this run ({shorten_text(error)}); remove it to start anew"
        ) from error


class RunFolder:
    """Folder of a training run: arguments, checkpoint, policy, learning curve, TensorBoard logs.

    Args:
        path: Path of the folder.
        arguments: Dataclass of the run's arguments; only the same run can be resumed.
        resume: Whether to continue an existing run; None if the script cannot resume runs.
        dataset: Name of the dataset, to which "auto" was resolved.
        free: Names of further arguments that may change when a run is resumed.
        unit: Unit of the steps of the learning curve: "decisions" or "gradient updates".

    Raises:
        ResultsError: The folder contains another run, or one that must not be resumed, or it
            cannot be created.

    Attributes:
        points: Evaluations of the run so far.
        unit: Unit of the steps of the learning curve.
    """

    #: Arguments that may change when a run is resumed: durations and paths.
    FREE = ("resume", "out", "data_dir", "decisions", "minutes")

    def __init__(
        self,
        path: Path,
        arguments: object,
        resume: bool | None,
        dataset: str,
        free: Sequence[str] = (),
        unit: str = DECISIONS,
    ) -> None:
        self.path, self.unit = path, unit
        recorded = {key: value for key, value in vars(arguments).items() if key not in (*self.FREE, *free)}
        recorded["dataset"] = dataset
        text = json.dumps(recorded, indent=1, default=repr)
        try:
            path.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise ResultsError(f"cannot make {path}: {error}") from error
        file = path / _ARGUMENTS
        if file.exists():
            self._check(_read_arguments(file), json.loads(text), resume)
        write_atomically(file, text)
        self.points = self._read_curve() if resume else []

    def _check(self, found: dict[str, Any], expected: dict[str, Any], resume: bool | None) -> None:
        if resume is None:
            raise ResultsError(f"{self.path} holds a run, which cannot be resumed; choose another --out")
        if not resume:
            raise ResultsError(f"{self.path} holds a run; pass --resume to continue it, or another --out")
        different = [key for key in found.keys() | expected.keys() if found.get(key) != expected.get(key)]
        if different:
            raise ResultsError(
                f"{self.path} holds a run with other arguments ({', '.join(sorted(different))}); use them again "
                "or choose another --out"
            )

    @property
    def policy(self) -> Path:
        """Path of the policy file in the run's folder."""
        return self.path / POLICY

    @property
    def checkpoint(self) -> Path:
        """Path of the checkpoint file in the run's folder."""
        return self.path / CHECKPOINT

    @property
    def seconds(self) -> float:
        """Wall-clock time from the start of the run to its last evaluation (s)."""
        return self.points[-1].seconds if self.points else 0.0

    def discard_points_after(self, count: int) -> None:
        """Discard evaluations after a number of steps in `unit`; a resumed run repeats them."""
        self.points = [point for point in self.points if point.steps <= count]

    def add(self, point: CurvePoint) -> None:
        """Add an evaluation to the learning curve, and write its table and plot."""
        self.points.append(point)
        stream = io.StringIO()
        writer = csv.DictWriter(stream, [part.name for part in fields(CurvePoint)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(point) for point in self.points)
        write_atomically(self.path / f"{CURVE}.csv", stream.getvalue())
        write_atomically(self.path / f"{CURVE}.png", draw_curve(self.points, self.unit))

    def _read_curve(self) -> list[CurvePoint]:
        path = self.path / f"{CURVE}.csv"
        if not path.exists():
            return []
        try:
            reader = csv.DictReader(io.StringIO(read_plain_file(path).decode(), newline=""))
            if reader.fieldnames != [part.name for part in fields(CurvePoint)]:
                raise ValueError(f"columns {reader.fieldnames}")
            return [_parse_point(row) for row in reader]
        except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
            raise ResultsError(
                f"{path}: not a learning curve of this library ({type(error).__name__}: {error}); remove it to "
                "resume without it"
            ) from error


def _read_arguments(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(read_plain_file(path))
        if not isinstance(found, dict):
            raise TypeError("not a dict")
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ResultsError(f"{path}: not the arguments of a run ({error}); choose another --out") from error
    return found


def _parse_point(row: dict[str, str]) -> CurvePoint:
    texts = {"dataset", "physics", "partner"}
    numbers = {key: int(row[key]) if key in ("steps", "episodes") else float(row[key]) for key in row.keys() - texts}
    return CurvePoint(**numbers, **{key: row[key] for key in texts})  # type: ignore[arg-type]
