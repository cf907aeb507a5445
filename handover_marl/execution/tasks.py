"""Functions that open a worker pool and apply a function to tasks with a progress bar."""

from collections.abc import Callable, Generator, Sequence
from contextlib import closing, nullcontext

from rich.console import Console
from rich.progress import track

from handover_marl.execution.local_pool import LocalPool
from handover_marl.execution.options import resolve_worker_count
from handover_marl.execution.pool import RAY, Pool, PoolConfig, Result, Task


def open_pool(config: PoolConfig) -> Pool:
    """Return a worker pool with a configuration; for Ray, connect to the cluster.

    Raises:
        UnknownNameError: The backend is unknown.
        OptionError: The configuration is invalid.
        WorkerError: The Ray cluster cannot be reached.
    """
    config.check()
    if config.backend == RAY:
        # Imported only here, because Ray is an optional dependency.
        from handover_marl.execution.ray_pool import RayPool

        return RayPool(config)
    return LocalPool(resolve_worker_count(config.workers))


def map_with_progress(
    make_function: Callable[[], Callable[[Task], Result]],
    tasks: Sequence[Task],
    description: str,
    config: PoolConfig,
    progress: bool,
) -> Generator[tuple[Task, Result], None, None]:
    """Apply a function to tasks in worker processes and yield (task, result) as tasks finish.

    Args:
        make_function: Factory of the function to apply; called once in every worker process.
        tasks: Picklable arguments of the function.
        description: Label of the progress bar.
        config: Configuration of the worker pool.
        progress: Whether to show the progress bar on stderr.

    Raises:
        HandoverError: As `Pool.map_unordered`.
    """
    finished = open_pool(config).map_unordered(
        lambda: nullcontext(make_function()), tasks, lambda task: f"{description}: {str(task)[:80]}"
    )
    with closing(finished):
        bar = track(finished, description, len(tasks), console=Console(stderr=True), disable=not progress)
        for index, result in bar:
            yield tasks[index], result
