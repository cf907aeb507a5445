"""Running the official protocol, one episode a scene: with the official giver, or with any pair of policies."""

import contextlib
import operator
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from handover_marl import givers, receivers
from handover_marl._version import __version__
from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.playing import REPLAY, Job, Task
from handover_marl.benchmarking.progress import BenchmarkProgress
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.results import ResultFolder, RunSettings
from handover_marl.benchmarking.workers import check_workers, play_tasks
from handover_marl.benchmarking.writing import write_report
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.splits import check_setup_and_split
from handover_marl.episode import check_physics
from handover_marl.errors import SceneError


def benchmark(
    setup: str = "s0",
    split: str = "test",
    receiver: str = "yang2021",
    *,
    scenes: Iterable[int] | None = None,
    data_dir: str | os.PathLike[str] | None = None,
    dataset: str = "auto",
    physics: str = "exact",
    out: str | os.PathLike[str] | None = None,
    progress: bool = True,
    workers: int | None = None,
    trust: bool = False,
) -> Report:
    """Run HandoverSim's official protocol and report its metrics.

    Args:
        setup: Official setup, "s0" to "s3".
        split: "train", "val" or "test".
        receiver: Name of a registered receiver.
        scenes: Only these scenes of the split; the report then says that it is partial.
        data_dir: Folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        dataset: "dexycb", "synthetic", or "auto": DexYCB when there is a data folder, else synthetic.
        physics: "exact", as official results are, or "fast" to look a receiver over quickly.
        out: Folder for official result files, `report.json` and `report.md`. Scenes that are finished there are
            not run again, so that an interrupted run goes on where it was.
        workers: Processes to play scenes in; default: one a core. Outcomes do not depend on it; planning times are
            wall clock and may, when processes share cores, so that the number is told with them.
        progress: Whether to show a progress bar and a row for every scene, on stderr.
        trust: Whether code in a policy file (`learned:FILE`) may run.

    Raises:
        UnknownNameError: No such setup, split, dataset, physics or receiver.
        SceneError: A scene is not in the split.
        DataNotFoundError, DataFormatError: Files are missing (noticed before the start) or damaged.
        ResultsError: `out` holds another run or cannot be written.
        ActionError: The receiver returned something that is no action.
        OptionError: `workers` is less than one.
        WorkerError: A worker process died twice over the same scene, or the receiver failed in one.
    """
    return evaluate_pair(
        REPLAY,
        receiver,
        setup,
        split,
        scenes=scenes,
        data_dir=data_dir,
        dataset=dataset,
        physics=physics,
        out=out,
        progress=progress,
        workers=workers,
        trust=trust,
    )


def evaluate_pair(
    giver: str = REPLAY,
    receiver: str = "yang2021",
    setup: str = "s0",
    split: str = "test",
    *,
    scenes: Iterable[int] | None = None,
    data_dir: str | os.PathLike[str] | None = None,
    dataset: str = "auto",
    physics: str = "exact",
    out: str | os.PathLike[str] | None = None,
    progress: bool = True,
    workers: int | None = None,
    trust: bool = False,
) -> Report:
    """Let any giver and any receiver play the scenes of a split under the official rules.

    Args:
        giver: Name of a registered giver, or `learned:FILE`; "replay" makes it the official benchmark.
        receiver: Name of a registered receiver, or `learned:FILE`.
        setup: As in `benchmark`, and so are the others.
        split: "train", "val" or "test".
        scenes: Only these scenes of the split.
        data_dir: Folder in HandoverSim's layout.
        dataset: "dexycb", "synthetic" or "auto".
        physics: "exact" or "fast".
        out: Result folder.
        progress: Whether to show a progress bar.
        workers: Processes to play scenes in.
        trust: Whether code in policy files may run.

    Raises:
        HandoverError: As `benchmark` does; UnknownNameError also if there is no such giver, and ActionError if the
            giver returned something that is no action.
    """
    check_setup_and_split(setup, split)
    check_physics(physics)
    giver_label = givers.make(giver, trust).label
    data = open_dataset(dataset, data_dir)
    split_ids = data.split(setup, split)
    chosen = _choose_scenes(split_ids, scenes, f"{setup} {split}")
    receiver_label = receivers.make(receiver, data, trust).label
    n_workers = check_workers(workers)
    data.check_scenes(chosen)
    settings = RunSettings(
        setup=setup,
        split=split,
        receiver=receiver_label,
        giver=giver_label,
        physics=physics,
        dataset=data.name,
        version=__version__,
    )
    folder = None if out is None else ResultFolder(Path(out).expanduser(), settings)
    tasks = [Task(split_ids.index(scene_id), scene_id) for scene_id in chosen]
    machine = f"{describe_machine()}, {min(n_workers, len(tasks))} at a time"
    job = Job(
        dataset=data.name,
        data_dir=None if data_dir is None else os.fspath(data_dir),
        receiver=receiver,
        giver=giver,
        physics=physics,
        machine=machine,
        trust=trust,
    )
    with BenchmarkProgress(len(tasks), shown=progress) as bar:
        results = _run(job, tasks, n_workers, folder, data, bar)
    report = Report(settings, tuple(results[task] for task in tasks), len(split_ids))
    if folder is not None:
        write_report(folder.path, report)
    return report


def _run(
    job: Job,
    tasks: Sequence[Task],
    workers: int,
    folder: ResultFolder | None,
    data: Dataset,
    bar: BenchmarkProgress,
) -> dict[Task, EpisodeResult]:
    """Take finished scenes from the folder and play the others."""
    results: dict[Task, EpisodeResult] = {}
    for task in tasks:
        known = None if folder is None else folder.finished(task.index, data.fingerprint(task.scene_id))
        if known is not None:
            results[task] = known
            bar.add(known, known=True)
    left = [task for task in tasks if task not in results]
    with contextlib.closing(play_tasks(job, left, workers)) as finished:
        for played in finished:
            if folder is not None:
                folder.save(played.result, played.actions, played.times)
            results[played.task] = played.result
            bar.add(played.result, known=False)
    return results


def _choose_scenes(split_ids: tuple[int, ...], scenes: Iterable[int] | None, where: str) -> tuple[int, ...]:
    if scenes is None:
        return split_ids
    try:
        wanted = sorted({operator.index(scene) for scene in scenes})
    except TypeError as error:
        raise SceneError(f"scenes={scenes!r}: expected scene numbers, such as [209, 214]") from error
    foreign = [scene for scene in wanted if scene not in split_ids]
    if foreign:
        raise SceneError(
            f"scene {foreign[0]} is not in {where}, which has {len(split_ids)} scenes from {split_ids[0]} to "
            f"{split_ids[-1]}; choose scenes of this split or another setup or split"
        )
    if not wanted:
        raise SceneError(f"no scene chosen; leave scenes out to run all {len(split_ids)} of {where}")
    return tuple(wanted)
