"""Official result folders: `config.yaml` and one `IDX.npz` a scene, IDX being its index within the split.

Official keys: `action` (T, 9), `elapsed_time` (T,) policy time of every step (s), `elapsed_frame` = T, `result`,
the status flags. Files written here hold the rest of an `EpisodeResult` besides, which official readers pass by.
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.settings import CONFIG_FILE, RunSettings, config_text, read_settings
from handover_marl.config import OFFICIAL, WorldConfig
from handover_marl.episode.fluency import Fluency
from handover_marl.errors import ResultsError
from handover_marl.files import check_archive, create_exclusively, write_arrays
from handover_marl.protocol.status import EpisodeStatus

#: What stands beside the results of scenes.
REPORT_FILES = ("report.json", "report.md", "report.html")
_REPLAYS = "episodes"
_RESULT_FILE = re.compile(r"([0-9]{3})\.npz")
_LARGEST = 64_000_000  # bytes of a scene's result, unpacked
_EXTRAS = {
    "scene_id": int,
    "release_step": int,
    "object_name": str,
    "subject": str,
    "side": str,
    "n_objects": int,
    "models": str,
    "fingerprint": str,
    "machine": str,
}
_FLUENCY = "fluency_"


def replay_path(folder: Path, scene_id: int) -> Path:
    """Where a result folder has the replay of a scene."""
    return folder / _REPLAYS / f"{scene_id:03d}.html"


def replay_paths(folder: Path) -> dict[int, Path]:
    """The replays that a result folder has, by scene."""
    paths = (folder / _REPLAYS).glob("[0-9][0-9][0-9].html")
    return {int(path.stem): path for path in sorted(paths)}


class ResultFolder:
    """A folder of finished scenes.

    Args:
        path: The folder; made, with its parents, if it is not there.
        settings: What is being run.
        config: The world and the rules that it is run under.
        fresh: Whether to remove the results of an earlier run that are there.

    Raises:
        ResultsError: The folder belongs to another run, holds something else, or cannot be written.
    """

    def __init__(self, path: Path, settings: RunSettings, config: WorldConfig = OFFICIAL, fresh: bool = False) -> None:
        self.path = path
        claim_folder(path, settings, config_text(settings, config), fresh)

    def finished(self, index: int, fingerprint: str) -> EpisodeResult | None:
        """The scene's result if it is there and whole, else None.

        Args:
            index: Position of the scene in the split.
            fingerprint: Hash of the data that the scene would be run on now.

        Raises:
            ResultsError: The scene was run on other data.
        """
        path = result_path(self.path, index)
        try:
            result = _read_result(path) if path.is_file() else None
        except ResultsError:
            return None
        if result is not None and result.fingerprint != fingerprint:
            raise ResultsError(f"{path} was made from other data than the present data folder's; choose another folder")
        return result

    def save(
        self, result: EpisodeResult, actions: npt.NDArray[np.float32], elapsed_time: npt.NDArray[np.float64]
    ) -> None:
        """Write one scene's official file.

        Args:
            result: Its outcome.
            actions: (T, 9) the action of every physics step.
            elapsed_time: (T,) policy time at every physics step (s), zero where the policy was not asked.
        """
        arrays: dict[str, Any] = {
            "action": actions,
            "elapsed_time": elapsed_time,
            "elapsed_frame": np.int64(result.steps),
            "result": np.int64(result.status),
            **{key: np.array(value) for key in _EXTRAS if (value := getattr(result, key)) is not None},
            **_fluency_arrays(result.fluency),
        }
        write_arrays(result_path(self.path, result.index), arrays)


def claim_folder(path: Path, settings: RunSettings, config: str, fresh: bool = False) -> None:
    """Make a folder that of a run, or see that it is.

    Args:
        path: The folder; made, with its parents, if it is not there.
        settings: What is run.
        config: Its `config.yaml`.
        fresh: Whether to remove the results of an earlier run that are there.

    Raises:
        ResultsError: The folder belongs to another run, holds something else, or cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        entries = [entry.name for entry in path.iterdir() if not entry.name.startswith(".")]
        if CONFIG_FILE not in entries and entries:
            raise ResultsError(
                f"{path} is not empty and has no {CONFIG_FILE}, so it is no result folder; choose another one"
            )
        if fresh and CONFIG_FILE in entries:
            # Whatever else has a file of that name is not ours to clear.
            read_settings(path)
            _clear(path, entries)
    except ResultsError:
        raise
    except (OSError, ValueError) as error:
        raise ResultsError(f"cannot use {path} as result folder: {_reason(error)}") from error
    # Of several runs that start at once in an empty folder one writes this, and the others read it.
    create_exclusively(path / CONFIG_FILE, config)
    _check_same_run(path, read_settings(path), settings)


def _clear(path: Path, entries: list[str]) -> None:
    for name in entries:
        if _RESULT_FILE.fullmatch(name) or name in (CONFIG_FILE, *REPORT_FILES):
            (path / name).unlink()
    for replay in replay_paths(path).values():
        replay.unlink()


def result_path(folder: Path, index: int) -> Path:
    """Where a result folder has the result of a scene, by its position in the split."""
    return folder / f"{index:03d}.npz"


def read_results(path: Path) -> list[EpisodeResult]:
    """All results of a folder, by index.

    Raises:
        ResultsError: A file is damaged, or there is none.
    """
    files = _result_files(path)
    if not files:
        raise ResultsError(f"{path} has no result files (000.npz, 001.npz, ...)")
    return [_read_result(file) for file in files]


def finished_indices(path: Path) -> list[int]:
    """Positions in the split of the scenes that a folder has results of, ascending.

    Raises:
        ResultsError: It cannot be read.
    """
    return [int(file.stem) for file in _result_files(path)]


def _result_files(path: Path) -> list[Path]:
    try:
        return sorted(entry for entry in path.iterdir() if _RESULT_FILE.fullmatch(entry.name))
    except OSError as error:
        raise ResultsError(f"cannot read {path}: {_reason(error)}") from error


def _read_result(path: Path) -> EpisodeResult:
    try:
        check_archive(path, _LARGEST)
        with np.load(path, allow_pickle=False) as archive:
            status, steps = int(archive["result"]), int(archive["elapsed_frame"])
            plan_time = float(np.sum(archive["elapsed_time"]))
            extras = {key: _extra(key, archive[key]) for key in _EXTRAS if key in archive}
            extras["fluency"] = _read_fluency(archive)
    except Exception as error:  # what NumPy and zipfile raise on damaged bytes has no end
        raise ResultsError(
            f"{path}: no readable result file ({type(error).__name__}: {error}); delete it and run the scene again"
        ) from error
    if not 0 < status < 16 or (status & 1 and status != 1) or steps < 1 or not 0.0 <= plan_time < np.inf:
        raise ResultsError(f"{path}: impossible result {status} after {steps} steps; run its scene again")
    return EpisodeResult(
        index=int(path.stem),
        status=EpisodeStatus(status),
        steps=steps,
        plan_time=plan_time,
        **extras,
    )


def _extra(key: str, array: npt.NDArray[Any]) -> Any:
    value = array.item()
    if type(value) is not _EXTRAS[key]:
        raise TypeError(f"{key} is {value!r}, expected {_EXTRAS[key].__name__}")
    return value


def _fluency_arrays(fluency: Fluency | None) -> dict[str, npt.NDArray[np.float64]]:
    """A number for each metric, NaN where there is none."""
    if fluency is None:
        return {}
    values = asdict(fluency).items()
    return {_FLUENCY + key: np.array(np.nan if value is None else value, dtype=np.float64) for key, value in values}


def _read_fluency(archive: Mapping[str, npt.NDArray[Any]]) -> Fluency | None:
    if _FLUENCY + fields(Fluency)[0].name not in archive:
        return None
    values = {part.name: float(archive[_FLUENCY + part.name]) for part in fields(Fluency)}
    if np.isinf(list(values.values())).any():
        raise ValueError("an infinite metric")
    return Fluency(**{key: None if np.isnan(value) else value for key, value in values.items()})  # type: ignore[arg-type]


def _check_same_run(path: Path, found: RunSettings, wanted: RunSettings) -> None:
    there, now = asdict(found), asdict(wanted)
    different = [
        f"{key.replace('_', ' ')} {value!r} there, {now[key]!r} now"
        for key, value in there.items()
        if value != now[key]
    ]
    if different:
        raise ResultsError(
            f"{path} holds another run ({'; '.join(different)}); choose another folder, or start anew with fresh=True "
            "(--fresh)"
        )


def _reason(error: Exception) -> str:
    return str((error.strerror if isinstance(error, OSError) else None) or error)
