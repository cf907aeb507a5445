"""Evaluation of receivers and givers by the official protocol: one episode per scene of a split."""

import contextlib
import hashlib
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.errors import OptionError, ResultsError, check_name
from handover_marl.evaluation.config import (
    REPLAY,
    REPLAY_CHOICES,
    REPLAYS_NONE,
    EvaluationConfig,
    ExecutionConfig,
    build_configs,
    resolve_config,
)
from handover_marl.evaluation.episode_runner import EpisodeWriter, SceneTask, run_episodes
from handover_marl.evaluation.replays import ReplayWriter
from handover_marl.evaluation.reports.episode_tables import format_scene_cells
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import write_report
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata
from handover_marl.evaluation.results.result_folder import ResultFolder
from handover_marl.execution.options import PoolConfig, check_pool, forward_signature
from handover_marl.execution.pool import Pool
from handover_marl.execution.tasks import open_pool, share_pool
from handover_marl.policies.reference import PolicyLike
from handover_marl.visualization.replay_scene import require_replay_extra

#: Function from result folder and resolved configuration to the writer of recordings beside the results.
MakeWriter: TypeAlias = Callable[[Path, EvaluationConfig], EpisodeWriter]

_SHARD = re.compile(r"(\d{1,4})/(\d{1,4})")
# Widths of the columns of the progress display; the sum fits a terminal of 80 columns.
_WIDTHS = {"scene id": 8, "object name": 22, "subject": 10, "side": 5, "outcome": 15, "steps": 5, "plan s": 6}
_COLORS = {"success": "green", "contact": "red", "drop": "yellow", "timeout": "magenta"}


@forward_signature(EvaluationConfig, ExecutionConfig, without=("giver", "world_config"))
def benchmark(
    setup: str | EvaluationConfig | None = None,
    split: str = "test",
    receiver: PolicyLike = "yang2021",
    execution: ExecutionConfig | None = None,
    **options: Any,
) -> Report:
    """Evaluate a receiver by HandoverSim's official protocol.

    Args:
        setup: Official setup, "s0" to "s3", or a setup of other data; or a whole `handover_marl.EvaluationConfig`.
        split: "train", "val" or "test".
        receiver: A registered name, with options or a file (`"omg:wait=1.5"`,
            `"learned:policy.npz"`), a class or an instance; see `handover_marl.policies.reference`.
        execution: Execution settings; or pass its fields as options.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        UnknownNameError: Unknown setup, split, dataset, physics or receiver.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing (checked first) or damaged.
        ResultsError: `out` holds another evaluation or cannot be written.
        ActionError: The receiver returned a malformed action.
        PolicyError: The receiver's code failed.
        OptionError: `workers` is less than one, or the world or the giver is not the official one.
        WorkerError: Two worker processes died over the same scene.
    """
    config, execution = build_configs(setup, options, execution, split=split, receiver=receiver)
    if config.world_config != OFFICIAL_CONFIG:
        raise OptionError("the official benchmark requires the official world and rules; use evaluate_pair for others")
    if config.giver != REPLAY:
        raise OptionError(f"the official giver is {REPLAY!r}; use evaluate_pair for others")
    (report,) = run_evaluations([("", config)], execution)
    return report


@forward_signature(EvaluationConfig, ExecutionConfig)
def evaluate_pair(
    giver: PolicyLike | EvaluationConfig = REPLAY,
    receiver: PolicyLike = "yang2021",
    setup: str | None = None,
    split: str = "test",
    execution: ExecutionConfig | None = None,
    **options: Any,
) -> Report:
    """Evaluate a giver with a receiver on the scenes of a split, under the official or other rules.

    Args:
        giver: The person's policy, given as `receiver` is; "replay" is the official giver. Or a
            whole `handover_marl.EvaluationConfig`.
        receiver: The robot's policy: a registered name, a class or an instance, as for `benchmark`.
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: "train", "val" or "test". The command `pair` evaluates "val" by default.
        execution: Execution settings; or pass its fields as options.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        HandoverError: The same errors as `benchmark`.
    """
    if isinstance(giver, EvaluationConfig):
        config, execution = build_configs(giver, options, execution)
    else:
        config, execution = build_configs(setup, options, execution, split=split, giver=giver, receiver=receiver)
    (report,) = run_evaluations([("", config)], execution)
    return report


def run_evaluations(
    parts: Sequence[tuple[str, EvaluationConfig]],
    execution: ExecutionConfig,
    recorded: str = "",
    make_writer: MakeWriter | None = None,
) -> list[Report]:
    """Evaluate several configurations in the same worker processes.

    Everything is checked, and all folders are prepared, before the first scene. Scenes with a result are not simulated.

    Args:
        parts: For each evaluation the subfolder of the output folder, "" for the folder itself, and the configuration.
        execution: Workers, output folder and replays.
        recorded: Description of further recordings, part of the identity of a result folder.
        make_writer: Function from result folder and resolved configuration to the writer of these recordings.

    Raises:
        HandoverError: The same errors as `benchmark`.
    """
    evaluations = [_Evaluation(config, execution.for_subfolder(name), recorded) for name, config in parts]
    reports = []
    with share_pool(execution) as open_workers:
        for evaluation in evaluations:
            reports.append(evaluation.run(open_workers, make_writer))
    return reports


class _Evaluation:
    """Evaluation of one giver with one receiver on the scenes of a split; see `run_evaluations`."""

    def __init__(self, config: EvaluationConfig, execution: ExecutionConfig, recorded: str) -> None:
        check_name("replays", execution.replays, REPLAY_CHOICES)
        if execution.replays != REPLAYS_NONE:
            if execution.folder is None:
                raise OptionError("replays need an output folder; pass out= (--out DIR)")
            require_replay_extra()
        check_pool(execution)
        self.config, dataset = resolve_config(config, execution.trust)
        split_ids = dataset.list_scenes(self.config.setup, self.config.split)
        scenes, shard = tuple(self.config.scenes or ()), execution.shard or ""
        if shard:
            self.config = replace(self.config, scenes=select_shard(shard, scenes))
            shard += "" if scenes == split_ids else f" of {','.join(map(str, scenes))}"
        self._execution = execution
        self._metadata = ResultMetadata.from_config(self.config, recorded, shard, len(split_ids))
        self._n_split_scenes = len(split_ids)
        self.folder: ResultFolder | None = None
        if execution.folder is not None:
            self.folder = ResultFolder(execution.folder, self._metadata, self.config.world_config, execution.fresh)
        indices = {scene: index for index, scene in enumerate(split_ids)}
        self._tasks = [
            SceneTask(indices[scene], scene, dataset.compute_fingerprint(scene)) for scene in self.config.scenes or ()
        ]

    def run(self, open_workers: Callable[[], Pool], make_writer: MakeWriter | None) -> Report:
        """Simulate the scenes that have no result yet, write the report and return it."""
        folder, replays = self.folder, self._execution.replays
        all_writers: tuple[EpisodeWriter, ...] = ()
        if folder is not None:
            recorders = [] if make_writer is None else [make_writer(folder.path, self.config)]
            replay_writers = [] if replays == REPLAYS_NONE else [ReplayWriter(folder.path, replays)]
            # The result folder is the last: its files mark scenes as finished.
            all_writers = (*recorders, *replay_writers, folder)
        found = [folder.read(task.index, task.fingerprint) if folder else None for task in self._tasks]
        stored = {task: result for task, result in zip(self._tasks, found, strict=True) if result is not None}
        results = {
            task: result for task, result in stored.items() if all(writer.contains(result) for writer in all_writers)
        }
        remaining = [task for task in self._tasks if task not in results]
        # Without tasks there is no need to connect to a cluster.
        pool = open_workers() if remaining else open_pool(PoolConfig(workers=1))
        with (
            _show_progress(len(self._tasks), results.values(), self._execution.progress) as show,
            contextlib.closing(run_episodes(self.config, remaining, pool, all_writers)) as finished,
        ):
            for number, (result, contents) in finished:
                task = remaining[number]
                _check_same_outcome(stored.get(task), result)
                for writer, content in zip(all_writers, contents, strict=True):
                    writer.write(result, content)
                results[task] = result
                show(result)
        episodes = tuple(results[task] for task in self._tasks)
        report = Report(self._metadata, episodes, self._n_split_scenes, len(self._tasks) - len(remaining))
        if folder is not None:
            write_report(folder.path, report)
        return report


def select_shard(shard: str, scenes: Sequence[int]) -> tuple[int, ...]:
    """Return the scenes of a shard such as "3/16", the third of 16, in the given order.

    Scenes are distributed in a fixed pseudo-random order, so that objects, people and hands are as
    mixed in every shard as in the whole; the sizes of two shards differ by one scene at most.

    Raises:
        OptionError: The text is not of this form, or there are fewer scenes than shards.
    """
    match = _SHARD.fullmatch(shard) if isinstance(shard, str) else None
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise OptionError(f"shard must be a number and a count, from 1/N to N/N, such as '3/16', got {shard!r}")
    number, count = int(match[1]), int(match[2])
    if len(scenes) < count:
        raise OptionError(f"shard {shard} needs {count} scenes or more, got {len(scenes)}; take fewer shards")
    shuffled = sorted(range(len(scenes)), key=lambda position: hashlib.sha256(b"%d" % position).digest())
    return tuple(scenes[position] for position in sorted(shuffled[number - 1 :: count]))


@contextlib.contextmanager
def _show_progress(
    n_scenes: int, stored: Collection[EpisodeResult], enabled: bool
) -> Iterator[Callable[[EpisodeResult], None]]:
    """Show a progress bar with the success rate on stderr; yield a function that adds a finished scene.

    Args:
        n_scenes: Number of scenes.
        stored: Results of an earlier run in the same folder, shown first.
        enabled: Whether to show anything.
    """
    if not enabled:
        yield lambda result: None
        return
    console = Console(stderr=True, highlight=False)
    successes: list[bool] = []

    def print_row(cells: Sequence[str], style: str) -> None:
        row = " ".join(cell.ljust(width) for cell, width in zip(cells, _WIDTHS.values(), strict=True))
        console.print(row.rstrip(), style=style)

    def add(result: EpisodeResult, style: str | None = None) -> None:
        successes.append(result.success)
        bar.update(task, advance=1, description=f"success {100 * sum(successes) / len(successes):5.1f} %")
        scene, name, subject, side, outcome, steps, _, plan_s = format_scene_cells(result)
        cells = (scene, name, subject.partition("-")[2], side, outcome, steps, plan_s)
        print_row(cells, style or _COLORS.get(outcome, "red"))

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task("success   -  ", total=n_scenes)
        print_row(tuple(_WIDTHS), "bold")
        if stored:
            text = f"{len(stored)} of {n_scenes} episodes are from an earlier run in this folder:"
            console.print(text, style="dim")
        for result in stored:
            add(result, "dim")
        yield add


def _check_same_outcome(stored: EpisodeResult | None, current: EpisodeResult) -> None:
    """Check that an episode that is simulated again, for its replay, ends as it did before."""
    if stored is not None and _describe_end(stored) != _describe_end(current):
        raise ResultsError(
            f"replaying scene {current.scene_id} gave another outcome ({_describe_end(stored)} before, "
            f"{_describe_end(current)} now): a policy is not deterministic, or the stored result was changed. The "
            "stored result is kept; delete all results with fresh=True (--fresh)"
        )


def _describe_end(result: EpisodeResult) -> str:
    release = "no release" if result.release_step is None else f"release after {result.release_step}"
    return f"{result.status.label} after {result.steps} steps, {release}"
