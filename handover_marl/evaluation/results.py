"""Results of episodes, official result folders, and small files with the outcomes of all scenes of an evaluation.

A result folder has `config.yaml` and one `IDX.npz` per scene, with IDX its index in the split. Official keys: `action`
(T, 9), `elapsed_time` (T,) policy time of every step (s), `elapsed_frame` = T, `result` the status flags. Files of this
library hold the other fields of `EpisodeResult` too, which official readers ignore.

An episode file (a "file of outcomes" in the documentation) is JSON without the actions. The key `metadata` holds the
identity of the evaluation, `common` the values that all episodes share, `columns` the keys of the other values, and
`episodes` one row for each scene. Keys and units are as in the episodes of `report.json`.
"""

import json
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Any, TypeAlias, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.episode.loop import ActionRecorder, EpisodeCallback
from handover_marl.episode.metrics.fluency import FluencyMetrics
from handover_marl.episode.metrics.motion import EpisodeTrace
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import ResultsError
from handover_marl.evaluation.config import EvaluationConfig
from handover_marl.evaluation.metadata import (
    CONFIG_FILE,
    ResultMetadata,
    check_metadata,
    format_config,
    read_result_metadata,
)
from handover_marl.execution.files import (
    create_exclusively,
    encode_arrays,
    remove_stale_temporaries,
    shorten_text,
    write_atomically,
)
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.policies.policy import Policy

#: Report files beside the results of the scenes.
REPORT_JSON = "report.json"
REPORT_FILES = (REPORT_JSON, "report.md", "report.html", "episodes.csv")
#: Folders of replay pages, time series and demonstrations in a result folder, and the file that describes the latter.
REPLAYS, TRACES, DEMONSTRATIONS, DEMONSTRATIONS_METADATA = "episodes", "traces", "demonstrations", "metadata.json"
_MAX_BYTES = 64_000_000  # unpacked size of one scene's result, or size of an episode file
_FLUENCY_PREFIX = "fluency_"
#: Fields of `EpisodeResult` that only evaluations with inference time have.
INFERENCE_KEYS = ("late_s", "early_grab")
_MAX_TEXT, _MAX_NUMBER = 10_000, 1e9  # characters of a description; largest number


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one simulated scene: outcome, times and metrics.

    Attributes:
        index: Position of the scene in its split; names the official result file.
        status: Outcome flags.
        steps: Physics steps (1 ms) until the end of the episode.
        plan_s: Wall-clock time spent in the receiver's policy (s).
        scene_id: Scene number, or None if unknown (results of HandoverSim's code).
        release_step: Physics step in which the giver released the object, or None.
        object_name: Class of the object handed over, or None if unknown.
        subject: Person recorded in the scene, or None if unknown.
        side: Hand that gives the object, "right" or "left", or None if unknown.
        n_objects: Number of objects in the scene, or None if unknown.
        models: Kind of hand model ("MANO hand") and substitutes for HandoverSim's other models; None if there is
            nothing to describe, or if unknown.
        fingerprint: Hash of the scene's data files, or None if unknown.
        machine: Machine and number of workers with which `plan_s` was measured, or None if unknown.
        fluency: Metrics beyond the official ones, or None if unknown.
        late_s: Simulated time that passed during decisions of the receiver (s); None without inference time.
        early_grab: Whether the fingers began to close before the person's offer, see `has_early_grab`; None without
            inference time, if the fingers do not close, or if no hand moves.
    """

    index: int
    status: EpisodeStatus
    steps: int
    plan_s: float
    scene_id: int | None = None
    release_step: int | None = None
    object_name: str | None = None
    subject: str | None = None
    side: str | None = None
    n_objects: int | None = None
    models: str | None = None
    fingerprint: str | None = None
    machine: str | None = None
    fluency: FluencyMetrics | None = None
    late_s: float | None = None
    early_grab: bool | None = None

    @property
    def success(self) -> bool:
        """Whether the handover was completed."""
        return self.status == EpisodeStatus.SUCCESS

    @property
    def speed_score(self) -> float:
        """Contribution to average success (AS): 1 - t / 13 s for a success after t s, at least 0; 0 without success."""
        return max(0.0, 1.0 - self.steps / OFFICIAL_CONFIG.protocol.horizon_steps) if self.success else 0.0


# Type of each field that HandoverSim's files lack.
_EXTRAS: dict[str, type] = {
    name: get_args(hint)[0]
    for name, hint in get_type_hints(EpisodeResult).items()
    if NoneType in get_args(hint) and name != "fluency"
}
_METRICS = tuple(field.name for field in fields(FluencyMetrics))
_STATUSES = {EpisodeStatus(bits).label: bits for bits in range(1, 16)}


#: Callback that records an episode while it is simulated, and function that encodes the last recording as one file,
#: given the episode's result and motion trace; empty if no file is needed.
EpisodeRecorder: TypeAlias = tuple[EpisodeCallback, Callable[[EpisodeResult, EpisodeTrace], bytes]]


class EpisodeWriter(ABC):
    """Writer of one file for each episode into the folder `path`, which is created if missing.

    The main process writes; worker processes hold a pickled copy, which only creates recorders. The constructor removes
    temporary files that killed processes left in the folder more than a day ago.

    Attributes:
        suffix: Suffix of the files. Arrays (000.npz) are named by the scene's index, others (209.csv) by its number.
    """

    suffix = ".npz"

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            remove_stale_temporaries(path)
        except (FileExistsError, NotADirectoryError) as error:
            raise ResultsError(f"cannot use {path}: it, or a part of it, is a file; out must be a folder") from error
        except OSError as error:
            raise ResultsError(f"cannot use {path}: {error.strerror or error}") from error

    @abstractmethod
    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Create, in a worker process, the callback that records episodes and the function that encodes its recording.

        Args:
            config: Resolved configuration of the evaluation.
            receiver: The robot's policy in this process.
        """

    def get_path(self, result: EpisodeResult) -> Path:
        """Return the path of the file of an episode."""
        number = result.index if self.suffix == ".npz" else result.scene_id or 0
        return self.path / f"{number:03d}{self.suffix}"

    def contains(self, result: EpisodeResult) -> bool:
        """Return whether the file of an episode exists already or is not needed.

        Episodes without their file are simulated again.
        """
        return self.get_path(result).is_file()

    def write(self, result: EpisodeResult, content: bytes) -> None:
        """Write the content of an episode's file; write no file if the content is empty."""
        if content:
            write_atomically(self.get_path(result), content)


def get_result_path(folder: Path, index: int) -> Path:
    """Return the path of a scene's result file or demonstration, given the scene's index in the split."""
    return folder / f"{index:03d}.npz"


def find_numbered(folder: Path, suffix: str) -> dict[int, Path]:
    """Return the paths of the files 000, 001, ... with a suffix such as ".npz" in a folder, by number, in order."""
    paths = [path for path in folder.glob(f"[0-9]*{suffix}") if path.stem.isdecimal()]
    found = [(int(path.stem), path) for path in paths if path.stem == f"{int(path.stem):03d}"]
    return dict(sorted(found))


def find_recordings(folder: Path) -> list[Path]:
    """Return the paths of the replay pages, time series, demonstrations and their description in a result folder."""
    kinds = ((REPLAYS, ".html"), (TRACES, ".csv"), (DEMONSTRATIONS, ".npz"))
    paths = [path for name, suffix in kinds for path in find_numbered(folder / name, suffix).values()]
    return [*paths, *(folder / DEMONSTRATIONS).glob(DEMONSTRATIONS_METADATA)]


class ResultFolder(EpisodeWriter):
    """Result folder of one evaluation, and writer of its official result files; the folder is created if missing.

    The text `config` is written to a new `config.yaml`; by default, it has the identity `metadata` and the official
    rules. A folder with another evaluation raises `ResultsError`; with `overwrite`, its results are deleted first.
    """

    def __init__(self, path: Path, metadata: ResultMetadata, config: str = "", overwrite: bool = False) -> None:
        super().__init__(path)
        try:
            entries = [entry.name for entry in path.iterdir() if not entry.name.startswith(".")]
            if entries and CONFIG_FILE not in entries:
                raise ResultsError(
                    f"{path} is not empty and has no {CONFIG_FILE}, so it is no result folder; choose another one"
                )
            if overwrite and entries:
                # Other programs use files of that name; their folders must not be cleared.
                read_result_metadata(path)
                reports = [path / name for name in (CONFIG_FILE, *REPORT_FILES)]
                for old in (*find_numbered(path, ".npz").values(), *find_recordings(path), *reports):
                    old.unlink(missing_ok=True)
        except OSError as error:
            raise ResultsError(f"cannot use {path} as result folder: {error.strerror or error}") from error
        # Of several evaluations that start at once in an empty folder, one writes this and the others read it.
        create_exclusively(path / CONFIG_FILE, config or format_config(metadata))
        different = read_result_metadata(path).describe_differences(metadata, "in the folder", "now")
        if different:
            raise ResultsError(
                f"{path} holds another evaluation ({'; '.join(different)}); choose another folder, or delete its "
                "results with overwrite=True (--overwrite)"
            )

    def read(self, index: int, fingerprint: str) -> EpisodeResult | None:
        """Read the result of a scene by its index in the split; None if the result file is missing or damaged.

        A result whose data had another hash than `fingerprint` raises `ResultsError`.
        """
        path = get_result_path(self.path, index)
        try:
            result = read_result(path)[0] if path.is_file() else None
        except ResultsError:
            return None
        if result is not None and result.fingerprint != fingerprint:
            raise ResultsError(f"{path} was computed from data that differ from the data folder; choose another folder")
        return result

    def create_recorder(self, config: EvaluationConfig, receiver: Policy) -> EpisodeRecorder:
        """Return a recorder of actions and planning times, and the function that encodes both as a result file."""
        recorder = ActionRecorder()
        return recorder, lambda result, _: encode_result(result, recorder.actions, recorder.times)


def encode_result(
    result: EpisodeResult, actions: npt.NDArray[np.float32], elapsed_time: npt.NDArray[np.float64]
) -> bytes:
    """Return the content of a scene's official result file (`.npz`).

    `actions` (T, 9) has the target joint positions in each of T physics steps, 7 arm joints (rad) and 2 fingers (m);
    `elapsed_time` (T,) the wall-clock time in the receiver's policy in each step (s), zero between decisions.
    """
    arrays: dict[str, Any] = {
        "action": actions,
        "elapsed_time": elapsed_time,
        "elapsed_frame": np.int64(result.steps),
        "result": np.int64(result.status),
        **{key: np.array(value) for key in _EXTRAS if (value := getattr(result, key)) is not None},
    }
    for key, value in (asdict(result.fluency) if result.fluency else {}).items():
        arrays[_FLUENCY_PREFIX + key] = np.array(np.nan if value is None else value, dtype=np.float64)
    return encode_arrays(arrays)


def read_results(path: Path, allow_empty: bool = False) -> list[EpisodeResult]:
    """Read all results of a folder, ordered by index; raise ResultsError if there are none, unless `allow_empty`."""
    files = find_numbered(path, ".npz").values()
    if not files and not allow_empty:
        raise ResultsError(f"{path} has no result files (000.npz, 001.npz, ...)")
    results = [read_result(file)[0] for file in files]
    _check_scenes_differ(results, path)
    return results


def _check_scenes_differ(results: Sequence[EpisodeResult], path: Path) -> None:
    """Raise `ResultsError` if two results that were read from a path are of the same scene."""
    for scene, count in Counter(result.scene_id for result in results).items():
        if scene is not None and count > 1:
            raise ResultsError(f"{path}: {count} results are of scene {scene}; delete those that were copied")


def _check_scalar(name: str, value: Any, kind: type) -> Any:
    """Return a file's value as a Python `kind` (int, str, ...); raise `TypeError` for other types and unsafe text."""
    scalar: Any = value.item() if isinstance(value, np.generic) else value
    # Control characters could change a terminal that prints the report.
    text = scalar if isinstance(scalar, str) else ""
    if type(scalar) is not kind or not text.isprintable() or len(text) > _MAX_TEXT:
        raise TypeError(f"{name} must be a printable {kind.__name__}, got {ascii(scalar)[:100]}")
    return scalar


def read_result(path: Path) -> tuple[EpisodeResult, npt.NDArray[Any]]:
    """Read the result and the array `action` of an official result file; raise `ResultsError` if that fails.

    The array is not checked; it should be (T, 9) for T physics steps, and is empty if the file has none.
    """
    try:
        arrays = read_arrays(path, largest=_MAX_BYTES)
        values: dict[str, Any] = {key.removeprefix(_FLUENCY_PREFIX): array[()] for key, array in arrays.items()}
        values |= {"status": values["result"], "steps": values["elapsed_frame"], "index": int(path.stem)}
        result = _parse_result({**values, "plan_s": np.sum(arrays["elapsed_time"])})
    except Exception as error:  # NumPy and zipfile raise exceptions of many types; arrays may have any shape and type
        raise ResultsError(
            f"{path}: not a readable result file ({type(error).__name__}: {error}); check its rights, or delete it and "
            "run the scene again"
        ) from error
    return result, arrays.get("action", np.zeros(0))


def _parse_result(values: Mapping[str, Any]) -> EpisodeResult:
    """Make a result from a file's values by field name; raise KeyError, TypeError or ValueError for impossible ones."""
    status, steps, plan_s = EpisodeStatus(int(values["status"])), int(values["steps"]), float(values["plan_s"])
    kinds = {"index": int} | {key: kind for key, kind in _EXTRAS.items() if values.get(key) is not None}
    known = {key: _check_scalar(key, values[key], kind) for key, kind in kinds.items()}
    if not 0 < status < 16 or (status & EpisodeStatus.SUCCESS and status != EpisodeStatus.SUCCESS):
        raise ValueError(f"impossible status {int(status)}")
    numbers = steps, plan_s, *(value for value in known.values() if isinstance(value, int))
    if not steps or not all(0 <= number <= _MAX_NUMBER for number in numbers):
        raise ValueError(f"impossible number, got {numbers}")
    metrics = {name: float(np.nan if values.get(name) is None else values[name]) for name in _METRICS}
    if not all(map(np.isnan, metrics.values())):
        unknown: Any = {name: None if np.isnan(value) else value for name, value in metrics.items()}
        known["fluency"] = FluencyMetrics(**unknown)
    return EpisodeResult(status=status, steps=steps, plan_s=plan_s, **known)


def describe_episode(episode: EpisodeResult) -> dict[str, Any]:
    """Return the fields of a result as JSON types, by name, and `outcome`, the text of the status, e.g. "success".

    Without inference time, the fields `late_s` and `early_grab` are left out.
    """
    values = {**asdict(episode), "status": int(episode.status), "outcome": episode.status.label}
    return values if episode.late_s is not None else {key: values[key] for key in values if key not in INFERENCE_KEYS}


def format_episode_file(metadata: ResultMetadata, episodes: Iterable[EpisodeResult]) -> str:
    """Return the content of an episode file: JSON text with the results of all episodes, without their actions.

    Planning times are rounded to 0.1 ms, and metrics to four significant digits.
    """
    rows = []
    for episode in episodes:
        values = describe_episode(episode)
        del values["status"]
        fluency = values.pop("fluency") or dict.fromkeys(_METRICS)
        metrics = {key: None if value is None else float(f"{value:.4g}") for key, value in fluency.items()}
        # The values that most readers look for come first.
        first = {key: values.pop(key) for key in ("index", "scene_id", "outcome")}
        rows.append({**first, **values, "plan_s": round(episode.plan_s, 4), **metrics})
    common = {key: value for key, value in rows[0].items() if all(row[key] == value for row in rows)}
    common.pop("index", None)  # of an evaluation of one scene
    columns = [key for key in rows[0] if key not in common]
    known = {key: value for key, value in common.items() if value is not None}
    header = {"metadata": metadata.to_dict(), "common": known, "columns": columns}
    lines = ",\n".join(f"  {json.dumps([row[key] for key in columns])}" for row in rows)
    return f'{json.dumps(header, indent=1)[:-2]},\n "episodes": [\n{lines}\n ]\n}}\n'


def read_episode_file(path: Path) -> tuple[ResultMetadata, list[EpisodeResult]]:
    """Read the identity and the results, by index, of an episode file; raise `ResultsError` if that fails."""
    try:
        content = json.loads(read_plain_file(path, _MAX_BYTES))
        content["metadata"].pop("shard", None)  # older files have it
        metadata = ResultMetadata(**content["metadata"])
        rows = [dict(zip(content["columns"], row, strict=True)) | content["common"] for row in content["episodes"]]
        results = [_parse_result({**row, "status": _STATUSES[row["outcome"]]}) for row in rows]
        if not rows or len({result.index for result in results}) < len(rows):
            raise ValueError("episodes must have at least one row, and each index once")
    except Exception as error:  # the file may have any content
        if (path.parent / CONFIG_FILE).exists():
            raise ResultsError(f"{path} is a file in a result folder; pass the folder {path.parent}") from error
        raise ResultsError(
            f"{path} is neither a result folder nor a JSON file of outcomes, such as those of "
            f"docs/results/data/episodes ({type(error).__name__}: {shorten_text(error)})"
        ) from error
    check_metadata(metadata, path)
    _check_scenes_differ(results, path)
    return metadata, sorted(results, key=lambda result: result.index)
