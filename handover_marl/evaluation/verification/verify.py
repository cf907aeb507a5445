"""Verification of a result folder by simulating its stored actions again."""

import contextlib
import functools
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import track

from handover_marl import __version__
from handover_marl.config import WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import choose_scenes
from handover_marl.errors import OptionError, ResultsError
from handover_marl.evaluation.config import EvaluationConfig, require_policy_reference, resolve_config
from handover_marl.evaluation.episode_runner import EpisodeRunner, SceneTask
from handover_marl.evaluation.results.metadata import (
    ResultMetadata,
    format_world_label,
    parse_world_label,
    read_result_metadata,
)
from handover_marl.evaluation.results.result_folder import get_result_path, read_result
from handover_marl.evaluation.verification.differences import (
    Difference,
    EpisodeCheck,
    Verification,
    compare_results,
)
from handover_marl.evaluation.verification.folder_checks import check_giver, check_reports
from handover_marl.evaluation.verification.stored_actions import StoredActions, read_actions
from handover_marl.execution.files import shorten_text
from handover_marl.execution.options import PoolConfig, check_path
from handover_marl.execution.tasks import open_pool
from handover_marl.policies.reference import PolicyLike
from handover_marl.policies.registry import check_stored_reference, list_available


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

    The receiver's code is not needed. The simulation uses the physics, robot, giver and seed that
    the folder states. Statuses, steps, release steps and descriptions must be equal, metrics equal
    up to rounding (1e-6). Planning times, the label and the hash of the receiver cannot be verified.

    Args:
        folder: Result folder, of this library or of HandoverSim; nothing in it is changed.
        data_dir: Data folder in HandoverSim's layout; default: the environment variable
            HANDOVER_MARL_DATA.
        scenes: Scene numbers to verify; default: all that have a result.
        giver: The person's policy; default: the registered policy that the folder names.
        world_config: World and rules; must be the same as in the evaluation. Default: the official ones, with the
            noise of the robot's initial joint positions that the folder states.
        workers: Number of worker processes; default: one per core.
        progress: Whether to show a progress bar on stderr.
        trust: Whether policy files may run code, and a class that the folder names as its giver may be imported.

    Raises:
        ResultsError: The folder cannot be read, or was made with another world.
        OptionError: The folder's giver must be passed.
        UnsafeFileError: The folder names a class of a module as its giver, and is not trusted.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing or damaged.
    """
    path = check_path("folder", folder)
    metadata = read_result_metadata(path)
    if world_config is None:
        world_config = _parse_world(path, metadata)
    if metadata.world != format_world_label(world_config):
        raise ResultsError(
            f"{path} was made with world {metadata.world!r}, not with {format_world_label(world_config)!r}; pass the "
            "evaluation's world_config"
        )
    data_dir = None if data_dir is None else str(check_path("data_dir", data_dir))
    dataset = open_dataset(metadata.dataset, data_dir, metadata.robot)
    split = dataset.list_scenes(metadata.setup, metadata.split)
    wanted = frozenset(choose_scenes(split, scenes, f"{metadata.setup} {metadata.split}"))
    tasks = [
        SceneTask(index, scene)
        for index, scene in enumerate(split)
        if scene in wanted and get_result_path(path, index).exists()
    ]
    if not tasks:
        raise ResultsError(f"{path} has no results of these scenes (000.npz, 001.npz, ...)")
    if giver is None:
        advice = f"pass giver={metadata.giver!r} (--giver {metadata.giver}), or "
        check_stored_reference(path, "giver", metadata.giver, trust, list_available("giver"), advice)
    config = EvaluationConfig(
        setup=metadata.setup,
        split=metadata.split,
        scenes=tuple(task.scene_id for task in tasks),
        dataset=metadata.dataset,
        data_dir=data_dir,
        physics=metadata.physics,
        giver=metadata.giver if giver is None else giver,
        receiver="hold",
        robot=metadata.robot,
        seed=_parse_seed(path, metadata),
        world_config=world_config,
    )
    config, _ = resolve_config(config, trust)
    open_checker = functools.partial(_open_checker, config, path, metadata.version == __version__)
    with contextlib.closing(open_pool(PoolConfig(workers)).map_unordered(open_checker, tasks, _describe_task)) as found:
        bar = track(found, "verify", len(tasks), console=Console(stderr=True), disable=not progress)
        checks = sorted((check for _, check in bar), key=lambda check: check.index)
    differences = [*check_giver(require_policy_reference(config.giver), metadata), *check_reports(path)]
    return Verification(metadata, tuple(checks), tuple(differences), len(split))


class EpisodeChecker:
    """Simulator of the stored actions of single scenes, in this process.

    Args:
        config: Resolved configuration of the evaluation.
        folder: Result folder.
        same_version: Whether the present version of the library made the folder.
    """

    def __init__(self, config: EvaluationConfig, folder: Path, same_version: bool) -> None:
        self._runner = EpisodeRunner(config, parallelism="")
        self._folder, self._same_version = folder, same_version

    def check(self, task: SceneTask) -> EpisodeCheck:
        """Simulate the stored actions of a scene and compare the result with the stored one."""
        file = get_result_path(self._folder, task.index)
        try:
            stored = read_result(file)
            actions = read_actions(file, stored.steps)
        except ResultsError as error:
            return EpisodeCheck(task.index, task.scene_id, (Difference(file.name, shorten_text(error), "a result"),))
        simulated = self._runner.run(task, StoredActions(actions)).result
        differences = compare_results(stored, simulated, self._same_version)
        return EpisodeCheck(task.index, task.scene_id, tuple(differences))

    def close(self) -> None:
        """Free the memory and the physics client of the simulation."""
        self._runner.close()


@contextlib.contextmanager
def _open_checker(
    config: EvaluationConfig, folder: Path, same_version: bool
) -> Iterator[Callable[[SceneTask], EpisodeCheck]]:
    with contextlib.closing(EpisodeChecker(config, folder, same_version)) as checker:
        yield checker.check


def _parse_seed(path: Path, metadata: ResultMetadata) -> int:
    try:
        return int(metadata.seed)
    except ValueError as error:
        raise ResultsError(f"{path}: seed must be an integer, got {shorten_text(metadata.seed)}") from error


def _parse_world(path: Path, metadata: ResultMetadata) -> WorldConfig:
    try:
        return parse_world_label(metadata.world)
    except (ValueError, OptionError) as error:
        raise ResultsError(f"{path}: not a readable world ({shorten_text(error)})") from error


def _describe_task(task: SceneTask) -> str:
    return f"verifying scene {task.scene_id}"
