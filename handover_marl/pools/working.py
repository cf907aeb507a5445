"""What callers of a pool need: tasks in, answers out."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing, nullcontext
from typing import TypeVar

from rich.console import Console
from rich.progress import track

from handover_marl.options import check_workers
from handover_marl.pools.crew import Crew
from handover_marl.pools.local_pool import LocalPool
from handover_marl.pools.pool import Job, Pool
from handover_marl.pools.pool_config import RAY, PoolConfig

_Task = TypeVar("_Task")
_Answer = TypeVar("_Answer")


def open_pool(config: PoolConfig) -> Pool:
    """The pool that is meant; with Ray it is connected to.

    Raises:
        UnknownNameError, OptionError: There can be no such pool.
        WorkerError: The Ray cluster cannot be reached.
    """
    config.check()
    if config.backend == RAY:
        # Only now, because it is an extra.
        from handover_marl.pools.ray_pool import RayPool

        return RayPool(config)
    return LocalPool(check_workers(config.workers))


def answers(pool: Pool, job: Job[_Task, _Answer], tasks: Sequence[_Task]) -> Generator[tuple[int, _Answer], None, None]:
    """Numbers of tasks and what came of each, as they are finished.

    One worker, or one task, of this machine is this process itself.

    Raises:
        WorkerError: A worker died twice over the same task.
        HandoverError: What a worker met, as it would have come up here.
    """
    if not tasks:
        return
    if not pool.elsewhere and min(pool.size, len(tasks)) == 1:
        with job.prepare() as work:
            yield from ((number, work(task)) for number, task in enumerate(tasks))
        return
    with Crew(pool, job, tasks) as crew:
        yield from crew.answers()


def worked_on(
    prepare: Callable[[], Callable[[_Task], _Answer]],
    things: Sequence[_Task],
    what: str,
    config: PoolConfig,
    progress: bool,
) -> Generator[tuple[_Task, _Answer], None, None]:
    """Every thing with what came of it, as they are finished, beside a progress bar.

    Args:
        prepare: Called once in every process; what it gives is called with every thing.
        things: What there is to do.
        what: What to call them beside the bar.
        config: Who does it.
        progress: Whether to show the bar on stderr.

    Raises:
        HandoverError: As `answers`.
    """
    job = Job(lambda: nullcontext(prepare()), lambda thing: f"{what}: {str(thing)[:80]}")
    done = answers(open_pool(config), job, things)
    with closing(done):
        for number, answer in track(done, what, len(things), console=Console(stderr=True), disable=not progress):
            yield things[number], answer
