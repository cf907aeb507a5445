"""Running the official protocol, one episode a scene: with the official giver, or with any pair of policies."""

import contextlib
from collections.abc import Sequence
from dataclasses import replace

from typing_extensions import Unpack

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.playing import Task
from handover_marl.benchmarking.progress import BenchmarkProgress
from handover_marl.benchmarking.replay_shelf import replay_shelves
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import ResultFolder
from handover_marl.benchmarking.scribes import Shelf
from handover_marl.benchmarking.settings import RunSettings
from handover_marl.benchmarking.task_pool import play_tasks
from handover_marl.benchmarking.writing import write_report
from handover_marl.config import OFFICIAL
from handover_marl.datasets.shards import Shard, ShardOfRun
from handover_marl.errors import OptionError, ResultsError
from handover_marl.options import shows
from handover_marl.policies.reference import PolicyLike
from handover_marl.run import REPLAY, Execution, Run, RunOptions, describe, resolve


@shows(Run, Execution, without=("giver", "config"))
def benchmark(
    setup: str | Run = "s0",
    split: str = "test",
    receiver: PolicyLike = "yang2021",
    execution: Execution | None = None,
    **options: Unpack[RunOptions],
) -> Report:
    """Run HandoverSim's official protocol and report its metrics.

    Args:
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.Run`.
        split: "train", "val" or "test".
        receiver: A registered name, with options or a file (`"omg:wait=1.5"`, `"learned:policy.npz"`), a class, an
            instance; see `handover_marl.policies.reference`.
        execution: How to run; or give its fields as options.
        options: The fields of `handover_marl.Run` and `handover_marl.Execution`, which say what they mean.

    Raises:
        UnknownNameError: No such setup, split, dataset, physics or receiver.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing (noticed before the start) or damaged.
        ResultsError: `out` holds another run or cannot be written.
        ActionError: The receiver returned something that is no action.
        PolicyError: The receiver's own code failed.
        OptionError: `workers` is less than one, or the world or the giver is not the official one.
        WorkerError: A worker process died twice over the same scene.
    """
    run, how = describe(setup, options, execution, split=split, receiver=receiver)
    if run.config != OFFICIAL:
        raise OptionError("the official benchmark has the official world and rules; for others: evaluate_pair")
    if run.giver != REPLAY:
        raise OptionError(f"the official giver is {REPLAY!r}; for others: evaluate_pair")
    return evaluate_run(run, how)


@shows(Run, Execution)
def evaluate_pair(
    giver: PolicyLike | Run = REPLAY,
    receiver: PolicyLike = "yang2021",
    setup: str = "s0",
    split: str = "test",
    execution: Execution | None = None,
    **options: Unpack[RunOptions],
) -> Report:
    """Let any giver and any receiver play the scenes of a split, under the official rules or others.

    Args:
        giver: As `receiver` in `benchmark`; "replay" makes it the official benchmark. Or a whole `handover_marl.Run`.
        receiver: As in `benchmark`, and so are the others.
        setup: Official setup, "s0" to "s3".
        split: "train", "val" or "test".
        execution: How to run.
        options: The fields of `handover_marl.Run` and `handover_marl.Execution`.

    Raises:
        HandoverError: As `benchmark` does.
    """
    if isinstance(giver, Run):
        run, how = describe(giver, options, execution)
    else:
        run, how = describe(setup, options, execution, split=split, giver=giver, receiver=receiver)
    return evaluate_run(run, how)


def evaluate_run(run: Run, execution: Execution, shelf: Shelf | None = None) -> Report:
    """What `evaluate_pair` does, for a description.

    Args:
        run: What is run.
        execution: How.
        shelf: What is kept of the episodes beside their results and replays, if anything; it needs a folder (`out`).

    Raises:
        HandoverError: As `benchmark` does.
    """
    shelves = [*([] if shelf is None else [shelf]), *replay_shelves(execution)]
    execution.pool.check()
    shard = None if execution.shard is None else Shard.parse(execution.shard)
    run, data = resolve(run, execution.trust)
    split_ids = data.split(run.setup, run.split)
    told = ""
    if shard is not None and run.scenes is not None:
        told = str(ShardOfRun(shard, None if run.scenes == split_ids else run.scenes))
        run = replace(run, scenes=shard.of(run.scenes))
    settings = RunSettings.of(run, ", ".join(filter(None, (shelf.described(run) for shelf in shelves))), told)
    folder = None if execution.folder is None else ResultFolder(execution.folder, settings, run.config, execution.fresh)
    if folder is not None:
        for kept in shelves:
            kept.open(folder.path, run, execution.fresh)
    tasks = [Task(split_ids.index(scene), scene, data.fingerprint(scene)) for scene in run.scenes or ()]
    with BenchmarkProgress(len(tasks), shown=execution.progress) as bar:
        before = _finished(tasks, folder)
        known = {task: result for task, result in before.items() if all(shelf.has(result) for shelf in shelves)}
        for result in known.values():
            bar.add(result, known=True)
        left = [task for task in tasks if task not in known]
        scribes = tuple(shelf.scribe for shelf in shelves)
        with contextlib.closing(play_tasks(run, left, execution.pool, scribes)) as finished:
            for played in finished:
                _check_same_end(before.get(played.task), played.result)
                # Before the result, which says that the scene is done.
                for kept, written in zip(shelves, played.written, strict=True):
                    kept.keep(played.result, written)
                if folder is not None:
                    folder.save(played.result, played.actions, played.times)
                known[played.task] = played.result
                bar.add(played.result, known=False)
    report = Report(settings, tuple(known[task] for task in tasks), len(split_ids), len(tasks) - len(left))
    if folder is not None:
        write_report(folder.path, report)
    return report


def _finished(tasks: Sequence[Task], folder: ResultFolder | None) -> dict[Task, EpisodeResult]:
    """Results that the folder has from an earlier run."""
    found = {} if folder is None else {task: folder.finished(task.index, task.fingerprint) for task in tasks}
    return {task: result for task, result in found.items() if result is not None}


def _check_same_end(before: EpisodeResult | None, now: EpisodeResult) -> None:
    """An episode that is played again, for what is to be kept of it, is the same episode."""
    if before is not None and _end(before) != _end(now):
        raise ResultsError(
            f"scene {now.scene_id} ended otherwise than in the earlier run ({_end(before)} there, {_end(now)} now), "
            "though nothing that is known of it has changed: the receiver or the giver does not repeat itself. What "
            "was there stays; start anew with fresh=True (--fresh)"
        )


def _end(result: EpisodeResult) -> str:
    release = "no release" if result.release_step is None else f"release after {result.release_step}"
    return f"{result.status.label} after {result.steps} steps, {release}"
