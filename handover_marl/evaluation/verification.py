"""Verification of result folders: stored actions are simulated again, without the receiver's code."""

import contextlib
import functools
import itertools
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track

from handover_marl.config import PANDA_DOF, TIME_STEP, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import choose_scenes
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference, resolve_config
from handover_marl.evaluation.episode_runner import EpisodeRunner, SceneTask
from handover_marl.evaluation.metadata import (
    ResultMetadata,
    format_world_label,
    parse_world_label,
    read_result_metadata,
)
from handover_marl.evaluation.reports.report import format_report_files, load_report
from handover_marl.evaluation.reports.tables import ReportTable, TabularResult
from handover_marl.evaluation.results import (
    REPORT_FILES,
    REPORT_JSON,
    EpisodeResult,
    describe_episode,
    get_result_path,
    read_result,
)
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import PoolConfig, check_path
from handover_marl.execution.pool import open_pool
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.reference import PolicyLike
from handover_marl.policies.registry import check_stored_reference, list_available
from handover_marl.version import __version__

Actions = npt.NDArray[np.float32]

_MAX_REPORT_BYTES = 64_000_000
# Values that are not compared (`status` is the same as `outcome`), and values that are compared in one version only.
_UNVERIFIED, _VERSIONED = ("plan_s", "late_s", "machine", "status"), ("fingerprint", "models")
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Difference:
    """Difference between a stored value of a result folder and the value of the new simulation, both as short texts.

    The `key` is the value's name in reports, e.g. "outcome" or "fluency.reach", or the name of a file. The scene number
    is None for a value of the folder's reports and policies.
    """

    scene_id: int | None
    key: str
    stored: str
    expected: str


@dataclass(frozen=True)
class Verification(TabularResult):
    """Result of verifying a result folder. `str(verification)` is text with a Markdown table.

    Attributes:
        metadata: Identity of the evaluation, as the folder states it.
        scenes: Numbers of the scenes that were simulated again, in the split's order.
        differences: Values that differ, first in the scenes in their order, then in the folder's policies and reports.
        n_unreported: Number of results in the folder that its report does not contain.
    """

    metadata: ResultMetadata
    scenes: tuple[int, ...]
    differences: tuple[Difference, ...]
    n_unreported: int = 0

    @property
    def is_verified(self) -> bool:
        """Whether all values in the folder equal the simulated or computed ones."""
        return not self.differences

    @property
    def changed_scenes(self) -> tuple[int, ...]:
        """Numbers of the scenes with at least one difference."""
        return tuple(dict.fromkeys(each.scene_id for each in self.differences if each.scene_id is not None))

    def build_sections(self) -> list[str | ReportTable]:
        """Build the description of the verified folder, the table of differences and the conclusion."""
        metadata, n = self.metadata, len(self.scenes)
        n_changed, n_absent = len(self.changed_scenes), self.metadata.split_size - n
        n_folder = sum(each.scene_id is None for each in self.differences)
        rows = [
            ["folder" if each.scene_id is None else str(each.scene_id), each.key, each.stored, each.expected]
            for each in self.differences
        ]
        return [
            f"{metadata.setup} {metadata.split}, {metadata.dataset}, receiver {metadata.receiver}, giver "
            f"{metadata.giver}, {metadata.physics} physics, handover_marl {metadata.version}: {n} of "
            f"{self.metadata.split_size} scenes simulated again from their stored actions.",
            "Not verified: planning times, and that the actions are those of the named receiver.",
            ""
            if metadata.version == __version__
            else f"Not compared, because version {metadata.version} wrote them: reports and hashes.",
            ReportTable(["scene id", "value", "stored", "simulated"], rows, n_keys=2),
            f"Not equal: episodes {n_changed} of {n}, values of the folder {n_folder}."
            if rows
            else f"Verified: all {n} episodes are equal.",
            f"{n_absent} of {self.metadata.split_size} scenes of the split were not simulated." if n_absent else "",
            f"{self.n_unreported} results of the folder are not in its report, which has the scenes of the last run."
            if self.n_unreported
            else "",
            "The giver's code, or the way in which it was named, differs from that of the evaluation."
            if any(each.key == "giver_hash" for each in self.differences)
            else "",
        ]


def verify(
    folder: str | os.PathLike[str],
    *,
    data_dir: str | os.PathLike[str] | None = None,
    scenes: Iterable[int] | None = None,
    giver: PolicyLike | None = None,
    world_config: WorldConfig | None = None,
    workers: int | None = None,
    progress: bool = True,
    trust: bool = False,
) -> Verification:
    """Simulate the stored actions of a result folder and compare outcomes and metrics.

    The receiver's code is not needed. The simulation uses the physics, robot, giver and seed that the folder states.
    Outcome, steps and release step of every scene must be equal, metrics up to rounding (1e-6); in the same version,
    also the scene's description and the giver's hash. Reports must agree with results. Times are not verified.

    Args:
        folder: Result folder, of this library or of HandoverSim; nothing in it is changed.
        data_dir: Folder of custom scenes, or in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        scenes: Scene numbers to verify; default: all scenes with a result.
        giver: The person's policy; default: the registered policy that the folder names.
        world_config: World and rules; must be the same as in the evaluation. Default: the official ones, with the
            noise of the robot's initial joint positions that the folder states.
        workers: Number of worker processes; default: one per core.
        progress: Whether to show a progress bar on stderr.
        trust: Whether modules may be imported that a policy file names, or that the folder names for its giver.

    Raises:
        ResultsError: The folder cannot be read, was made with another world, or has no result of these scenes.
        OptionError: `giver` must be passed, because the folder names one that is not registered.
        UnsafeFileError: The folder names a class of a module as its giver, and `trust` is not set.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing or damaged.
    """
    path = check_path("folder", folder)
    metadata = read_result_metadata(path)
    try:
        seed, world = int(metadata.seed), world_config or parse_world_label(metadata.world)
    except (ValueError, OptionError) as error:
        raise ResultsError(f"{path}: not a readable seed or world ({shorten_text(error)})") from error
    if metadata.world != format_world_label(world):
        raise ResultsError(
            f"{path} was made with world {metadata.world!r}, not with {format_world_label(world)!r}; pass the "
            "evaluation's world_config"
        )
    split = open_dataset(metadata.dataset, data_dir, metadata.robot).list_scenes(metadata.setup, metadata.split)
    wanted = choose_scenes(split, scenes, f"{metadata.setup} {metadata.split}")
    tasks = [SceneTask(index, scene) for index, scene in enumerate(split) if scene in wanted]
    tasks = [task for task in tasks if get_result_path(path, task.index).exists()]
    if not tasks:
        raise ResultsError(f"{path} has no results of these scenes (000.npz, 001.npz, ...)")
    if giver is None:
        giver, registered = metadata.giver, list_available("giver")
        # The label of a policy file has the name and hash of the file, not its path.
        if giver.startswith("learned:") or (":" not in giver and giver not in registered):
            raise OptionError(
                f"giver must be passed: {path} names {giver!r}, which is not registered; pass giver='module:Class' "
                "(--giver module:Class), or giver='learned:FILE' for a policy file"
            )
        advice = f"pass giver={giver!r} (--giver {giver}), or "
        check_stored_reference(path, "giver", giver, trust, registered, advice)
    same: Any = {name: getattr(metadata, name) for name in ("setup", "split", "dataset", "physics", "robot")}
    ids = tuple(task.scene_id for task in tasks)
    if metadata.inference_time:
        # Stored actions are those in effect, so that they act at once.
        same["inference_time"] = 0.0
    config = EvaluationConfig(
        **same, scenes=ids, data_dir=data_dir, giver=giver, receiver="hold", seed=seed, world_config=world
    )
    config, _ = resolve_config(config, trust)
    is_same_version = metadata.version == __version__

    @contextlib.contextmanager
    def open_checker() -> Iterator[Callable[[SceneTask], list[Difference]]]:
        with contextlib.closing(EpisodeRunner(config)) as runner:
            yield functools.partial(check_episode, runner, path, is_same_version)

    with contextlib.closing(open_pool(PoolConfig(workers))) as pool:
        found = pool.map_unordered(open_checker, tasks, lambda task: f"verifying scene {task.scene_id}")
        bar = track(found, "verify", len(tasks), console=Console(stderr=True), disable=not progress)
        checks = [differences for _, differences in sorted(bar)]
    reference = require_policy_reference(config.giver)
    expected = {"giver": reference.label} | ({"giver_hash": reference.code_hash} if is_same_version else {})
    differences = _compare_json({key: getattr(metadata, key) for key in expected}, expected)
    in_reports, n_unreported = check_reports(path)
    return Verification(metadata, ids, (*itertools.chain(*checks), *differences, *in_reports), n_unreported)


def check_episode(runner: EpisodeRunner, folder: Path, same_version: bool, task: SceneTask) -> list[Difference]:
    """Simulate a scene with its stored actions; return the differences, or a single one if the result is damaged."""
    file = get_result_path(folder, task.index)
    try:
        stored, actions = read_result(file)
        receiver = StoredActions(check_actions(file, actions, stored.steps))
    except ResultsError as error:
        return [Difference(task.scene_id, file.name, shorten_text(error), "a result")]
    return compare_results(stored, runner.run(task, receiver)[0], same_version)


def compare_results(stored: EpisodeResult, simulated: EpisodeResult, same_version: bool) -> list[Difference]:
    """Return the differences between a stored and a simulated result, the outcome first.

    Planning and inference times, and values that HandoverSim's files lack, are not compared. Versions of the library
    may compute hashes of data and descriptions of models differently, so these are compared only with `same_version`.
    """
    values, expected = describe_episode(stored), describe_episode(simulated)
    skipped = {*_UNVERIFIED, *(() if same_version else _VERSIONED)}
    if stored.scene_id is None:
        skipped.update(key for key, value in values.items() if value is None)
    values, expected = ({key: each[key] for key in each.keys() - skipped} for each in (values, expected))
    differences = [replace(each, scene_id=simulated.scene_id) for each in _compare_json(values, expected)]
    # The outcome matters most.
    return sorted(differences, key=lambda each: each.key != "outcome")


def check_reports(path: Path) -> tuple[list[Difference], int]:
    """Compare the reports in a result folder with reports that are computed from its result files.

    Of `report.json`, the first difference is returned. Reports of other versions are not compared. The report may have
    fewer scenes than the folder, because it contains only the scenes of the last run.

    Returns:
        The differences, and the number of results in the folder that the report does not contain.
    """
    try:
        report = load_report(path)
    except ResultsError as error:
        return [Difference(None, "results", shorten_text(error), "readable results")], 0
    names = [name for name in REPORT_FILES if (path / name).exists()]
    if report.metadata.version != __version__ or not names:
        return [], 0
    n_results = len(report.episodes)
    try:
        stored = json.loads(read_plain_file(path / REPORT_JSON, _MAX_REPORT_BYTES))
        reported = {episode["index"] for episode in stored["episodes"]}
        absent = sorted(reported - {episode.index for episode in report.episodes})
        if absent:
            return [Difference(None, get_result_path(path, absent[0]).name, "no file", "a result of the report")], 0
        episodes = tuple(episode for episode in report.episodes if episode.index in reported) or report.episodes
        n_resumed = min(max(int(stored["n_resumed"]), 0), len(episodes))
        report = replace(report, episodes=episodes, n_resumed=n_resumed)
        differences = _compare_json(stored, json.loads(json.dumps(report.to_json())), REPORT_JSON)[:1]
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        differences = [Difference(None, REPORT_JSON, shorten_text(error), "a report")]
    for name, text in format_report_files(path, report).items():
        if name in names and name != REPORT_JSON and (path / name).read_bytes() != text.encode():
            differences.append(Difference(None, name, "other text", "the text of these results"))
    return differences, n_results - len(report.episodes)


def _compare_json(stored: Any, expected: Any, key: str = "") -> list[Difference]:
    """Return the differences of two values of JSON types; each is named by its path, such as "KEY.times[0]" for `key`.

    A stored float may differ from the expected number by 1e-6, relative or absolute.
    """
    if isinstance(stored, dict) and isinstance(expected, dict):
        names = sorted(stored.keys() | expected.keys())
        parts = [_compare_json(stored.get(name), expected.get(name), f"{key}.{name}".lstrip(".")) for name in names]
    elif isinstance(stored, list) and isinstance(expected, list) and len(stored) == len(expected):
        pairs = enumerate(zip(stored, expected, strict=True))
        parts = [_compare_json(found, wanted, f"{key}[{index}]") for index, (found, wanted) in pairs]
    else:
        is_equal = stored == expected
        if isinstance(stored, float) and isinstance(expected, (int, float)):
            is_equal = math.isclose(stored, expected, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE)
        return [] if is_equal else [Difference(None, key, _format_value(stored), _format_value(expected))]
    return [difference for part in parts for difference in part]


def _format_value(value: object) -> str:
    text = "none" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


class StoredActions:
    """Receiver that plays stored actions (T, 9), one per physics step, and ignores its observations.

    The last action is held if the episode goes on for longer.
    """

    name = "stored actions"
    #: No observation is computed.
    obs_mode = None

    def __init__(self, actions: Actions) -> None:
        changes = 1 + np.flatnonzero(np.any(actions[1:] != actions[:-1], axis=1))
        self._starts: list[int] = [0, *changes.tolist()]
        self._actions = actions
        self._next = 0

    def prepare(self, object_names: Sequence[str]) -> None:
        """Do nothing: stored actions need no preparation."""

    def reset(self, seed: int | None = None) -> None:
        """Start again with the first action; the seed is not used."""
        self._next = 0

    def act(self, observation: Observation) -> Actions:
        """Return the next action (9,) that differs from the last one; the observation is not used."""
        action: Actions = self._actions[self._starts[self._next]]
        self._next += 1
        return action

    @property
    def hold_time(self) -> float:
        """Time (s) for which the last action is held: until the next different one; infinite if there is none."""
        if self._next == len(self._starts):
            return np.inf
        return (self._starts[self._next] - self._starts[self._next - 1]) * TIME_STEP


def check_actions(path: Path, actions: npt.NDArray[Any], n_steps: int) -> Actions:
    """Return a file's actions as float32; raise `ResultsError` unless they are finite floats (`n_steps`, 9)."""
    if actions.shape != (n_steps, PANDA_DOF) or actions.dtype.kind != "f" or not np.isfinite(actions).all():
        raise ResultsError(
            f"{path}: action must be finite float32 of shape ({n_steps}, {PANDA_DOF}), got {actions.dtype} "
            f"{actions.shape}"
        )
    # HandoverSim stores actions in the type that its policies return; the simulation applies float32.
    return actions.astype(np.float32)
