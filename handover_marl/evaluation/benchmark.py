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

from handover_marl.errors import OptionError, ResultsError, check_name
from handover_marl.evaluation.config import (
    REPLAY,
    REPLAYS_ALL,
    REPLAYS_NONE,
    EvaluationConfig,
    ExecutionConfig,
    build_configs,
    resolve_config,
)
from handover_marl.evaluation.episode_runner import SceneTask, run_episodes
from handover_marl.evaluation.metadata import ResultMetadata, format_config
from handover_marl.evaluation.recordings import ReplayWriter, TraceWriter
from handover_marl.evaluation.reports.report import Report, write_report
from handover_marl.evaluation.results import TRACES, EpisodeResult, EpisodeWriter, ResultFolder
from handover_marl.execution.options import forward_signature
from handover_marl.execution.pool import open_pool
from handover_marl.policies.reference import PolicyLike
from handover_marl.visualization.replay_scene import require_replay_extra

#: Function from result folder and resolved configuration to the writer of recordings beside the results.
MakeWriter: TypeAlias = Callable[[Path, EvaluationConfig], EpisodeWriter]

_SHARD = re.compile(r"(\d{1,4})/(\d{1,4})")


_NOT_OFFICIAL = dict.fromkeys(
    ("giver", "world_config", "inference_time"), "use evaluate_pair for results that are not official"
)


@forward_signature(EvaluationConfig, ExecutionConfig, without=_NOT_OFFICIAL)
def benchmark(
    setup: str | None = None, split: str = "test", receiver: PolicyLike = "yang2021", **options: Any
) -> Report:
    """Evaluate a receiver by HandoverSim's official protocol.

    Args:
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: "train", "val" or "test".
        receiver: A registered name, with options or a file (`"omg:wait=1.5"`,
            `"learned:policy.npz"`), a class or an instance; see `handover_marl.policies.reference`.
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        UnknownNameError: Unknown setup, split, dataset, physics or receiver.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing (checked first) or damaged.
        ResultsError: `out` holds another evaluation or cannot be written.
        ActionError: The receiver returned a malformed action.
        PolicyError: The receiver's code failed.
        OptionError: A value is out of range, an option needs `out`, the world or the giver is not the official one, or
            inference takes simulated time.
        WorkerError: A worker process died (on Ray twice over the same scene), or Ray cannot be reached.
    """
    config, execution = build_configs(options, setup=setup, split=split, receiver=receiver)
    (report,) = run_evaluations([("", config)], execution)
    return report


@forward_signature(EvaluationConfig, ExecutionConfig)
def evaluate_pair(
    giver: PolicyLike = REPLAY,
    receiver: PolicyLike = "yang2021",
    setup: str | None = None,
    split: str = "val",
    **options: Any,
) -> Report:
    """Evaluate a giver with a receiver on the scenes of a split, under the official or other rules.

    Args:
        giver: The person's policy, in the same forms as `receiver`; "replay" is the official giver.
        receiver: The robot's policy: a registered name, a class or an instance, as for `benchmark`.
        setup: Official setup, "s0" to "s3", or a setup of other data; default: the first of the dataset.
        split: "train", "val" or "test".
        options: Fields of `handover_marl.EvaluationConfig` and `handover_marl.ExecutionConfig`.

    Raises:
        HandoverError: The same errors as `benchmark`.
    """
    config, execution = build_configs(options, giver=giver, receiver=receiver, setup=setup, split=split)
    (report,) = run_evaluations([("", config)], execution)
    return report


def run_evaluations(
    parts: Sequence[tuple[str, EvaluationConfig]],
    execution: ExecutionConfig,
    recorded: str = "",
    make_writer: MakeWriter | None = None,
) -> list[Report]:
    """Evaluate several configurations in the same worker processes; return one report for each.

    Everything is checked, and all folders are prepared, before the first scene. Scenes with a result and all requested
    recordings are not simulated again. Reports are written to the folders. Errors are those of `benchmark`.

    Args:
        parts: Pairs (subfolder of the output folder, configuration), one for each evaluation; "" is the folder itself.
        execution: Workers, output folder, replays and time series.
        recorded: Description of further recordings, such as demonstrations; stored in the folders' `config.yaml`.
        make_writer: Function from result folder and resolved configuration to the writer of these recordings.
    """
    reports = []
    with contextlib.closing(open_pool(execution)) as pool:
        prepared = [_prepare(config, execution, name, recorded) for name, config in parts]
        for config, metadata, folder, tasks in prepared:
            writers: list[EpisodeWriter] = []
            if folder is not None:
                if make_writer is not None:
                    writers.append(make_writer(folder.path, config))
                if execution.replays != REPLAYS_NONE:
                    writers.append(ReplayWriter(folder.path, execution.replays))
                if execution.traces:
                    writers.append(TraceWriter(folder.path / TRACES))
                # The result folder is the last: its files mark scenes as finished.
                writers.append(folder)
            stored = {task: folder.read(task.index, task.fingerprint) if folder else None for task in tasks}
            results = {
                task: result
                for task, result in stored.items()
                if result is not None and all(writer.contains(result) for writer in writers)
            }
            remaining = [task for task in tasks if task not in results]
            with (
                _show_progress(len(tasks), results.values(), execution.progress) as show,
                contextlib.closing(run_episodes(config, remaining, pool, tuple(writers))) as finished,
            ):
                for number, (result, contents) in finished:
                    _check_same_outcome(stored[remaining[number]], result)
                    for writer, content in zip(writers, contents, strict=True):
                        writer.write(result, content)
                    results[remaining[number]] = result
                    show(result)
            reports.append(Report(metadata, tuple(results[task] for task in tasks), len(tasks) - len(remaining)))
            if folder is not None:
                write_report(folder.path, reports[-1])
    return reports


def _prepare(
    config: EvaluationConfig, execution: ExecutionConfig, subfolder: str, recorded: str
) -> tuple[EvaluationConfig, ResultMetadata, ResultFolder | None, list[SceneTask]]:
    """Check an evaluation and prepare its folder; return resolved configuration, identity, folder and scene tasks.

    The folder is None if nothing is written. With a shard, scenes and tasks are only those of the shard.
    """
    check_name("replays", execution.replays, (REPLAYS_NONE, "failed", REPLAYS_ALL))
    for name, is_wanted in (("replays", execution.replays != REPLAYS_NONE), ("traces", execution.traces)):
        if is_wanted and execution.folder is None:
            raise OptionError(f"{name} need an output folder; pass out= (--out DIR)")
    if execution.replays != REPLAYS_NONE:
        require_replay_extra()
    config, dataset = resolve_config(config, execution.trust)
    split_ids = dataset.list_scenes(config.setup, config.split)
    if execution.shard is not None:
        if execution.overwrite:
            raise OptionError(
                "overwrite (--overwrite) must be left out with a shard, got both: it deletes the results of other "
                "shards in the folder; empty the folder before the first shard"
            )
        config = replace(config, scenes=select_shard(execution.shard, tuple(config.scenes or ())))
    indices = {scene: index for index, scene in enumerate(split_ids)}
    tasks = [SceneTask(indices[scene], scene, dataset.compute_fingerprint(scene)) for scene in config.scenes or ()]
    metadata = ResultMetadata.from_config(config, recorded, len(split_ids))
    folder = None
    if execution.folder is not None:
        text = format_config(metadata, config.world_config)
        folder = ResultFolder(execution.folder / subfolder, metadata, text, execution.overwrite)
    return config, metadata, folder, tasks


def select_shard(shard: str, scenes: Sequence[int]) -> tuple[int, ...]:
    """Return the scenes of a shard such as "3/16", the third of 16, in the given order.

    Scenes are distributed in a fixed pseudo-random order, so that objects, people and hands are mixed in every shard
    about as in the whole; the sizes of two shards differ by one scene at most. A wrong shard raises `OptionError`.
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
    """Show a progress bar with the success rate on stderr if enabled; yield a function that adds a finished scene.

    The bar has `n_scenes` scenes in all; `stored` results of an earlier run in the same folder count as finished.
    """
    n_finished, n_success = len(stored), sum(result.success for result in stored)

    def add(result: EpisodeResult) -> None:
        nonlocal n_finished, n_success
        n_finished, n_success = n_finished + 1, n_success + result.success
        bar.update(task, advance=1, description=f"success {100 * n_success / n_finished:5.1f} %")
        outcome = f"{result.status.label:12} {result.steps:>5} steps, plan {result.plan_s:.3f} s"
        bar.console.print(f"{result.scene_id!s:>5} {result.object_name or '':22} {outcome}")

    console = Console(stderr=True, highlight=False, quiet=not enabled)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console, disable=not enabled) as bar:
        task = bar.add_task("success   -  ", total=n_scenes, completed=n_finished)
        yield add


def _check_same_outcome(stored: EpisodeResult | None, current: EpisodeResult) -> None:
    """Raise `ResultsError` if a scene that was simulated again for a recording ended otherwise than its stored result.

    Status, number of steps and release step are compared; `stored` is None for a scene without a stored result.
    """
    before, now = (
        f"{result.status.label} after {result.steps} steps, release at {result.release_step}"
        for result in (stored or current, current)
    )
    if before != now:
        raise ResultsError(
            f"replaying scene {current.scene_id} gave another outcome ({before} before, {now} now): a policy is not "
            "deterministic, or the stored result was changed. The stored result is kept; delete all results with "
            "overwrite=True (--overwrite)"
        )
