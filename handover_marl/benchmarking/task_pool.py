"""Playing scenes in several processes, here or on the nodes of a cluster.

Nodes share no files with this machine. What goes to them is the description of the run, with the policies that were
typed in and the files of those that have some; what must be there is this library with the packages it needs, and
DexYCB, where it is not the synthetic scenes. Both are checked before a scene is played.
"""

import contextlib
import functools
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from platform import node
from tempfile import TemporaryDirectory
from typing import Any

from handover_marl.benchmarking.playing import Played, Player, Task
from handover_marl.benchmarking.scribes import ScribeMaker
from handover_marl.datasets.data_place import ADVICE, DataPlace
from handover_marl.errors import DataNotFoundError
from handover_marl.policies.parcels import Parcel
from handover_marl.pools.pool import Job
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import answers, open_pool
from handover_marl.run import Run, reference_of

_AGENTS = ("giver", "receiver")


def play_tasks(
    run: Run, tasks: Sequence[Task], config: PoolConfig, scribes: tuple[ScribeMaker, ...] = ()
) -> Generator[Played, None, None]:
    """Play scenes, in this process or in several, and yield each as it is finished.

    Args:
        run: What is run, resolved.
        tasks: The scenes.
        config: Who plays.
        scribes: Who puts the episodes into writing besides.

    Raises:
        WorkerError: A worker died twice over the same scene, or the cluster cannot be reached or used.
        HandoverError: What a worker met, as it would have come up here.
    """
    if not tasks:
        return
    pool = open_pool(config)
    company = " ".join(filter(None, (f"{min(pool.size, len(tasks))} at a time", pool.place)))
    prepare = functools.partial(_away, *_packed(run)) if pool.elsewhere else functools.partial(_here, run)
    job = Job(functools.partial(prepare, company, scribes), _words)
    with contextlib.closing(answers(pool, job, tasks)) as played:
        yield from (one for _, one in played)


def _words(task: Task) -> str:
    return f"playing scene {task.scene_id}"


@contextlib.contextmanager
def _here(run: Run, company: str, scribes: tuple[ScribeMaker, ...]) -> Iterator[Callable[[Task], Played]]:
    player = Player(run, company, scribes)
    try:
        yield player.play
    finally:
        player.close()


def _packed(run: Run) -> tuple[Run, DataPlace, tuple[Parcel, ...]]:
    return run, DataPlace.of(run.data_dir), tuple(Parcel.of(reference_of(getattr(run, agent))) for agent in _AGENTS)


@contextlib.contextmanager
def _away(
    run: Run, data: DataPlace, parcels: tuple[Parcel, ...], company: str, scribes: tuple[ScribeMaker, ...]
) -> Iterator[Callable[[Task], Played]]:
    """The same on a machine that has other files."""
    with TemporaryDirectory() as folder:
        policies: dict[str, Any] = {parcel.reference.agent: parcel.unpacked(Path(folder)) for parcel in parcels}
        there = replace(run, data_dir=data.here(), **policies)
        try:
            there.open_dataset()
        except DataNotFoundError as error:
            raise DataNotFoundError(f"on node {node()}: {error} {ADVICE}") from error
        with _here(there, company, scribes) as play:
            yield play
