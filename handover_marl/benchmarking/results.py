"""Official result folders: `config.yaml` and one `IDX.npz` a scene, IDX being its index within the split.

Official keys: `action` (T, 9), `elapsed_time` (T,) policy time of every step (s), `elapsed_frame` = T, `result`,
the status flags. Files written here hold the rest of an `EpisodeResult` besides, which official readers pass by.
"""

import io
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets.splits import SETUPS, SPLITS
from handover_marl.errors import ResultsError
from handover_marl.files import write_atomically
from handover_marl.fluency import Fluency
from handover_marl.protocol.status import EpisodeStatus

CONFIG_FILE = "config.yaml"
_RESULT_FILE = re.compile(r"(\d{3})\.npz")
_OWN_SECTION = "HANDOVER_MARL"
_EXTRAS = {
    "scene_id": int,
    "release_step": int,
    "object_name": str,
    "subject": str,
    "side": str,
    "n_objects": int,
    "fingerprint": str,
    "machine": str,
}
_FLUENCY = "fluency_"


@dataclass(frozen=True)
class RunSettings:
    """What a result folder is about; scenes run under different settings never share a folder.

    Attributes:
        setup: Official setup.
        split: Its split.
        receiver: Name of the receiver.
        giver: Name of the giver.
        physics: Kind of physics.
        dataset: Name of the dataset.
        version: Version of this library, or "HandoverSim" for folders of the original code.
    """

    setup: str
    split: str
    receiver: str
    giver: str
    physics: str
    dataset: str
    version: str


class ResultFolder:
    """A folder of finished scenes.

    Args:
        path: The folder; made, with its parents, if it is not there.
        settings: What is being run.

    Raises:
        ResultsError: The folder belongs to another run, holds something else, or cannot be written.
    """

    def __init__(self, path: Path, settings: RunSettings) -> None:
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            entries = [entry.name for entry in path.iterdir() if not entry.name.startswith(".")]
        except OSError as error:
            raise ResultsError(f"cannot use {path} as result folder: {error.strerror or error}") from error
        if CONFIG_FILE in entries:
            _check_same_run(path, read_settings(path), settings)
        elif entries:
            raise ResultsError(
                f"{path} is not empty and has no {CONFIG_FILE}, so it is no result folder; choose another one"
            )
        else:
            write_atomically(path / CONFIG_FILE, _config_text(settings))

    def finished(self, index: int, fingerprint: str) -> EpisodeResult | None:
        """The scene's result if it is there and whole, else None.

        Args:
            index: Position of the scene in the split.
            fingerprint: Hash of the data that the scene would be run on now.

        Raises:
            ResultsError: The scene was run on other data.
        """
        path = self.path / f"{index:03d}.npz"
        try:
            result = _read_result(path) if path.is_file() else None
        except ResultsError:
            return None
        if result is not None and result.fingerprint != fingerprint:
            raise ResultsError(
                f"{path} was made from other data than the present data folder's; choose another folder"
            )
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
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)
        write_atomically(self.path / f"{result.index:03d}.npz", stream.getvalue())


def read_settings(path: Path) -> RunSettings:
    """Settings of a result folder, ours or the original code's.

    Raises:
        ResultsError: There is no readable `config.yaml` with an official setup and split, or our section of it
            is not as this library writes it.
    """
    config_path = path / CONFIG_FILE
    try:
        config = yaml.safe_load(config_path.read_text())
        own = config.get(_OWN_SECTION)
        named = {"setup": config["BENCHMARK"]["SETUP"], "split": config["BENCHMARK"]["SPLIT"]}
        settings = RunSettings(**named, **(_official_section(path) if own is None else own))
    except FileNotFoundError as error:
        raise ResultsError(f"{path} is no result folder: it has no {CONFIG_FILE}") from error
    except Exception as error:  # YAML lets errors of its constructors through
        raise ResultsError(
            f"{config_path}: not a readable configuration ({type(error).__name__}: {error})"
        ) from error
    if settings.setup not in SETUPS or settings.split not in SPLITS:
        raise ResultsError(f"{config_path}: unknown setup {settings.setup!r} or split {settings.split!r}")
    for key, value in asdict(settings).items():
        if not isinstance(value, str):
            raise ResultsError(f"{config_path}: {key} in section {_OWN_SECTION} is {value!r}, expected text")
    return settings


def _official_section(path: Path) -> dict[str, str]:
    """What a folder of the original code stands for."""
    return {
        "receiver": _method_in_name(path.resolve().name),
        "giver": "replay",
        "physics": "exact",
        "dataset": "dexycb",
        "version": "HandoverSim",
    }


def read_results(path: Path) -> list[EpisodeResult]:
    """All results of a folder, by index.

    Raises:
        ResultsError: A file is damaged, or there is none.
    """
    files = sorted(entry for entry in path.iterdir() if _RESULT_FILE.fullmatch(entry.name))
    if not files:
        raise ResultsError(f"{path} has no result files (000.npz, 001.npz, ...)")
    return [_read_result(file) for file in files]


def _read_result(path: Path) -> EpisodeResult:
    try:
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
    return {
        _FLUENCY + key: np.array(np.nan if value is None else value, dtype=np.float64) for key, value in values
    }


def _read_fluency(archive: Mapping[str, npt.NDArray[Any]]) -> Fluency | None:
    if _FLUENCY + fields(Fluency)[0].name not in archive:
        return None
    values = {part.name: float(archive[_FLUENCY + part.name]) for part in fields(Fluency)}
    return Fluency(**{key: None if np.isnan(value) else value for key, value in values.items()})  # type: ignore[arg-type]


def _check_same_run(path: Path, found: RunSettings, wanted: RunSettings) -> None:
    different = [
        f"{key} {value!r} there, {asdict(wanted)[key]!r} now"
        for key, value in asdict(found).items()
        if value != asdict(wanted)[key]
    ]
    if different:
        raise ResultsError(f"{path} holds another run ({'; '.join(different)}); choose another folder")


def _config_text(settings: RunSettings) -> str:
    own = asdict(settings)
    protocol = ProtocolConfig()
    time_step = PhysicsConfig().time_step
    config: dict[str, Any] = {
        "SIM": {"TIME_STEP": time_step},
        "BENCHMARK": {
            "SETUP": own.pop("setup"),
            "SPLIT": own.pop("split"),
            "GOAL_CENTER": list(protocol.goal_center),
            "GOAL_RADIUS": protocol.goal_radius,
            "SUCCESS_TIME_THRESH": protocol.success_steps * time_step,
            "MAX_EPISODE_TIME": protocol.horizon_steps * time_step,
        },
        _OWN_SECTION: own,
    }
    return yaml.safe_dump(config, sort_keys=False)


def _method_in_name(folder: str) -> str:
    """The original code names folders `<date>_<time>_<method>_<setup>_<split>`."""
    match = re.fullmatch(r"[\d-]+_[\d-]+_(.+)_s[0-3]_(train|val|test)", folder)
    return match.group(1) if match else folder
