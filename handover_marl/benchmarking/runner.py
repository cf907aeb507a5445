"""Running the official protocol, one episode a scene: with the official giver, or with any pair of policies."""

import contextlib
from collections.abc import Sequence

from typing_extensions import Unpack

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.playing import Task
from handover_marl.benchmarking.progress import BenchmarkProgress
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import ResultFolder
from handover_marl.benchmarking.settings import RunSettings
from handover_marl.benchmarking.workers import play_tasks
from handover_marl.benchmarking.writing import write_report
from handover_marl.config import OFFICIAL
from handover_marl.datasets import Dataset
from handover_marl.errors import OptionError
from handover_marl.options import check_workers, shows
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


def evaluate_run(run: Run, execution: Execution) -> Report:
    """What `evaluate_pair` does, for a description.

    Raises:
        HandoverError: As `benchmark` does.
    """
    n_workers = check_workers(execution.workers)
    run, data = resolve(run, execution.trust)
    settings = RunSettings.of(run)
    split_ids = data.split(run.setup, run.split)
    folder = None if execution.folder is None else ResultFolder(execution.folder, settings, run.config, execution.fresh)
    tasks = [Task(split_ids.index(scene_id), scene_id) for scene_id in run.scenes or ()]
    machine = f"{describe_machine()}, {min(n_workers, len(tasks))} at a time"
    with BenchmarkProgress(len(tasks), shown=execution.progress) as bar:
        known = _finished(tasks, folder, data, bar)
        left = [task for task in tasks if task not in known]
        with contextlib.closing(play_tasks(run, machine, left, n_workers)) as finished:
            for played in finished:
                if folder is not None:
                    folder.save(played.result, played.actions, played.times)
                known[played.task] = played.result
                bar.add(played.result, known=False)
    report = Report(settings, tuple(known[task] for task in tasks), len(split_ids), len(tasks) - len(left))
    if folder is not None:
        write_report(folder.path, report)
    return report


def _finished(
    tasks: Sequence[Task], folder: ResultFolder | None, data: Dataset, bar: BenchmarkProgress
) -> dict[Task, EpisodeResult]:
    """Results that the folder has from an earlier run."""
    results: dict[Task, EpisodeResult] = {}
    for task in tasks:
        known = None if folder is None else folder.finished(task.index, data.fingerprint(task.scene_id))
        if known is not None:
            results[task] = known
            bar.add(known, known=True)
    return results
