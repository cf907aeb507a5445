"""Official result folders: `config.yaml` and one `IDX.npz` per scene, with IDX its index in the split.

Official keys: `action` (T, 9), `elapsed_time` (T,) policy time of every step (s), `elapsed_frame` = T,
`result` the status flags. Files of this library hold the other fields of `EpisodeResult` too, which
official readers ignore.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG, WorldConfig
from handover_marl.episode.callbacks import ActionRecorder
from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.episode_runner import EpisodeRecorder, EpisodeWriter
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import (
    CONFIG_FILE,
    ResultMetadata,
    format_config,
    read_result_metadata,
)
from handover_marl.execution.files import create_exclusively, remove_stale_temporaries, shorten_text
from handover_marl.execution.reading import read_arrays
from handover_marl.policies.policy import Policy

#: Report files beside the results of the scenes.
REPORT_JSON = "report.json"
REPORT_FILES = (REPORT_JSON, "report.md", "report.html", "episodes.csv")
_REPLAYS, _DEMONSTRATIONS = "episodes", "demonstrations"
_MAX_BYTES = 64_000_000  # unpacked size of one scene's result
# Type of each field that HandoverSim's files lack.
_EXTRAS: dict[str, type] = {
    name: get_args(hint)[0]
    for name, hint in get_type_hints(EpisodeResult).items()
    if NoneType in get_args(hint) and name != "fluency"
}
_METRICS = tuple(field.name for field in fields(FluencyMetrics))
_FLUENCY_PREFIX = "fluency_"
_MAX_TEXT = 10_000  # characters of a description
_MAX_NUMBER, _MAX_OBJECTS, _MAX_SCENES = 1e9, 1000, 10_000_000
# Smallest and largest possible values.
_LIMITS: dict[str, tuple[float, float]] = {
    "status": (1, 15),
    "steps": (1, _MAX_NUMBER),
    "plan_s": (0.0, _MAX_NUMBER),
    "scene_id": (0, _MAX_SCENES - 1),
    "release_step": (0, _MAX_NUMBER),
    "n_objects": (1, _MAX_OBJECTS),
}


def get_result_path(folder: Path, index: int) -> Path:
    """Return the path of a scene's result file, given the scene's index in the split."""
    return folder / f"{index:03d}.npz"


def get_replay_path(folder: Path, scene_id: int) -> Path:
    """Return the path of a scene's replay page."""
    return folder / _REPLAYS / f"{scene_id:03d}.html"


def find_replays(folder: Path) -> dict[int, Path]:
    """Return the paths of the replay pages in a result folder, by scene number."""
    return {int(path.stem): path for path in _find_numbered(folder / _REPLAYS, ".html")}


def get_demonstration_path(folder: Path, index: int) -> Path:
    """Return the path of a scene's demonstration, given the scene's index in the split."""
    return folder / _DEMONSTRATIONS / f"{index:03d}.npz"


def get_demonstrations_metadata_path(folder: Path) -> Path:
    """Return the path of the file that describes all demonstrations of a result folder."""
    return folder / _DEMONSTRATIONS / "metadata.json"


def find_demonstrations(folder: Path) -> list[Path]:
    """Return the paths of the demonstrations in a result folder, in the order of the split."""
    return _find_numbered(folder / _DEMONSTRATIONS, ".npz")


def find_recordings(folder: Path) -> list[Path]:
    """Return the paths of all files that are kept beside the results: replay pages and demonstrations."""
    metadata = get_demonstrations_metadata_path(folder)
    return [*find_replays(folder).values(), *find_demonstrations(folder), *([metadata] if metadata.exists() else [])]


def _find_numbered(folder: Path, suffix: str) -> list[Path]:
    """Return the files 000, 001, ... of a folder with a suffix, by number."""
    numbers = {path: int(path.stem) for path in folder.glob(f"[0-9]*{suffix}") if path.stem.isdecimal()}
    return sorted((path for path, number in numbers.items() if path.stem == f"{number:03d}"), key=numbers.__getitem__)


def prepare_subfolder(path: Path) -> None:
    """Create the folder of recordings in a result folder; remove files that killed processes left there.

    Raises:
        ResultsError: The folder cannot be created.
    """
    try:
        path.mkdir(exist_ok=True)
        remove_stale_temporaries(path)
    except OSError as error:
        raise ResultsError(f"cannot use {path}: {error.strerror or error}") from error


class ResultFolder(EpisodeWriter):
    """Result folder of one evaluation, and the writer of its official result files.

    Args:
        path: Path of the folder; created with its parents if missing.
        metadata: Identity of the evaluation.
        config: World and rules of the evaluation.
        fresh: Whether to delete the results of an earlier evaluation first.

    Raises:
        ResultsError: The folder belongs to another evaluation, holds other files, or cannot be written.
    """

    def __init__(
        self, path: Path, metadata: ResultMetadata, config: WorldConfig = OFFICIAL_CONFIG, fresh: bool = False
    ) -> None:
        self.path = path
        prepare_result_folder(path, metadata, format_config(metadata, config), fresh)

    def read(self, index: int, fingerprint: str) -> EpisodeResult | None:
        """Read the result of a scene; None if the result file is missing or damaged.

        Args:
            index: Index of the scene in the split.
            fingerprint: Hash of the scene's present data.

        Raises:
            ResultsError: The result was computed from other data.
        """
        path = get_result_path(self.path, index)
        try:
            result = read_result(path) if path.is_file() else None
        except ResultsError:
            return None
        if result is not None and result.fingerprint != fingerprint:
            raise ResultsError(f"{path} was computed from data that differ from the data folder; choose another folder")
        return result

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create the recorder of actions and policy times in one worker process."""
        return _ResultRecorder()

    def contains(self, result: EpisodeResult) -> bool:
        """Return whether the result file of an episode exists."""
        return get_result_path(self.path, result.index).is_file()

    def get_path(self, result: EpisodeResult) -> Path:
        """Return the path of the official result file of a scene."""
        return get_result_path(self.path, result.index)


class _ResultRecorder(ActionRecorder, EpisodeRecorder):
    """Recorder of actions and policy times that encodes the official result file."""

    def encode(self, result: EpisodeResult) -> bytes:
        """Return the content of the official result file (.npz)."""
        return encode_result(result, self.actions, self.times)


def encode_result(
    result: EpisodeResult, actions: npt.NDArray[np.float32], elapsed_time: npt.NDArray[np.float64]
) -> bytes:
    """Return the content of a scene's official result file.

    Args:
        result: Outcome of the episode.
        actions: (T, 9) action of every physics step.
        elapsed_time: (T,) policy time at every physics step (s), zero between decisions.
    """
    stream = io.BytesIO()
    arrays: dict[str, Any] = {
        "action": actions,
        "elapsed_time": elapsed_time,
        "elapsed_frame": np.int64(result.steps),
        "result": np.int64(result.status),
        **{key: np.array(value) for key in _EXTRAS if (value := getattr(result, key)) is not None},
        **{
            _FLUENCY_PREFIX + key: np.array(np.nan if value is None else value, dtype=np.float64)
            for key, value in (asdict(result.fluency) if result.fluency else {}).items()
        },
    }
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def prepare_result_folder(path: Path, metadata: ResultMetadata, config: str, fresh: bool = False) -> None:
    """Create the result folder of an evaluation, or check that an existing one belongs to it.

    Args:
        path: Path of the folder; created with its parents if missing.
        metadata: Identity of the evaluation.
        config: Content of its `config.yaml`.
        fresh: Whether to delete the results of an earlier evaluation first.

    Raises:
        ResultsError: The folder belongs to another evaluation, holds other files, or cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        entries = [entry.name for entry in path.iterdir() if not entry.name.startswith(".")]
        if entries and CONFIG_FILE not in entries:
            raise ResultsError(
                f"{path} is not empty and has no {CONFIG_FILE}, so it is no result folder; choose another one"
            )
        if fresh and entries:
            # Other programs use files of that name; their folders must not be cleared.
            read_result_metadata(path)
            for old in (*_find_numbered(path, ".npz"), *find_recordings(path)):
                old.unlink()
            for name in (CONFIG_FILE, *REPORT_FILES):
                (path / name).unlink(missing_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot use {path} as result folder: {error.strerror or error}") from error
    # Of several evaluations that start at once in an empty folder, one writes this and the others read it.
    create_exclusively(path / CONFIG_FILE, config)
    different = read_result_metadata(path).describe_differences(metadata, "in the folder", "now")
    if different:
        raise ResultsError(
            f"{path} holds another evaluation ({'; '.join(different)}); choose another folder, or delete its results "
            "with fresh=True (--fresh)"
        )


def read_results(path: Path, allow_empty: bool = False) -> list[EpisodeResult]:
    """Read all results of a folder, ordered by index.

    Raises:
        ResultsError: A file is damaged, or the folder has no results although `allow_empty` is False.
    """
    files = _find_numbered(path, ".npz")
    if not files and not allow_empty:
        raise ResultsError(f"{path} has no result files (000.npz, 001.npz, ...)")
    results = [read_result(file) for file in files]
    check_scenes_differ(results, path)
    return results


def check_scenes_differ(results: Sequence[EpisodeResult], path: Path) -> None:
    """Check that no two results that were read from a path are of the same scene.

    Raises:
        ResultsError: Two results are of the same scene.
    """
    known: dict[int, int] = {}
    for result in results:
        if result.scene_id is not None and known.setdefault(result.scene_id, result.index) != result.index:
            raise ResultsError(
                f"{path}: {known[result.scene_id]:03d}.npz and {result.index:03d}.npz are both of scene "
                f"{result.scene_id}; delete the one that was copied"
            )


def check_scalar(name: str, value: Any, kind: type) -> Any:
    """Convert a value that was read from a file to a Python number or text.

    Raises:
        TypeError: The value is of another type.
        ValueError: The text has control characters or is too long.
    """
    scalar = value.item() if isinstance(value, np.generic) else value
    if type(scalar) is not kind:
        raise TypeError(f"{name} must be of type {kind.__name__}, got {type(scalar).__name__}")
    # Control characters could change a terminal that prints the report.
    if isinstance(scalar, str) and not (scalar.isprintable() and len(scalar) <= _MAX_TEXT):
        raise ValueError(
            f"{name} must be text without control characters, at most {_MAX_TEXT} characters, got {ascii(scalar)[:100]}"
        )
    return scalar


def load_result_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Load all arrays of a result file.

    Raises:
        ResultsError: The file is damaged or too large.
    """
    try:
        return read_arrays(path, largest=_MAX_BYTES)
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise _make_read_error(path, error) from error


def read_result(path: Path) -> EpisodeResult:
    """Read a result file.

    Raises:
        ResultsError: The file is damaged, or its values are impossible.
    """
    arrays = load_result_arrays(path)
    try:
        values = {key.removeprefix(_FLUENCY_PREFIX): array[()] for key, array in arrays.items()}
        values |= {"status": values["result"], "steps": values["elapsed_frame"]}
        return parse_result({**values, "plan_s": np.sum(arrays["elapsed_time"])}, int(path.stem))
    except Exception as error:  # arrays may have any shape and type
        raise _make_read_error(path, error) from error


def parse_result(values: Mapping[str, Any], index: int) -> EpisodeResult:
    """Return the result of an episode from values that were read from a file.

    Args:
        values: Fields of `EpisodeResult` and of `FluencyMetrics` by name, as Python or NumPy scalars; unknown ones may
            be None or missing.
        index: Position of the scene in its split.

    Raises:
        KeyError, TypeError, ValueError: A value is missing, of another type or impossible.
    """
    status, steps, plan_s = int(values["status"]), int(values["steps"]), float(values["plan_s"])
    extras: dict[str, Any] = {
        key: check_scalar(key, values[key], kind) for key, kind in _EXTRAS.items() if values.get(key) is not None
    }
    known = {"status": status, "steps": steps, "plan_s": plan_s, **extras}
    for key, (low, high) in _LIMITS.items():
        if key in known and not low <= known[key] <= high:
            raise ValueError(f"impossible {key} {shorten_text(known[key])}")
    if status & EpisodeStatus.SUCCESS and status != EpisodeStatus.SUCCESS:
        raise ValueError(f"impossible status {status}")
    metrics = {name: float(np.nan if values.get(name) is None else values[name]) for name in _METRICS}
    if np.any(np.abs(list(metrics.values())) > _MAX_NUMBER):  # false for NaN, a missing metric
        raise ValueError(f"a metric is beyond {_MAX_NUMBER:g}")
    if not all(map(np.isnan, metrics.values())):
        unknown: Any = {name: None if np.isnan(value) else value for name, value in metrics.items()}
        extras["fluency"] = FluencyMetrics(**unknown)
    return EpisodeResult(index=index, status=EpisodeStatus(status), steps=steps, plan_s=plan_s, **extras)


def _make_read_error(path: Path, error: Exception) -> ResultsError:
    if isinstance(error, PermissionError):
        return ResultsError(f"{path} cannot be read ({error.strerror or error}); check its rights")
    return ResultsError(
        f"{path}: not a readable result file ({type(error).__name__}: {error}); delete it and run the scene again"
    )
