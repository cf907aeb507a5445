"""Worker processes on this machine, and functions that apply pools to tasks.

Processes are started by the library loky. Unlike with multiprocessing, the caller's script is not imported again in
the workers, so that it needs no `if __name__ == "__main__"`.
"""

import functools
import os
import re
import signal
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, nullcontext
from typing import Any

from loky.process_executor import ProcessPoolExecutor
from rich.console import Console
from rich.progress import track

from handover_marl.errors import WorkerError
from handover_marl.execution.options import RAY, PoolConfig, check_pool, resolve_worker_count
from handover_marl.execution.pool import (
    Job,
    OpenWorker,
    Pool,
    Result,
    Task,
    pickle_by_value,
    run_pickled_task,
    unpickle_result,
)

_EXIT_CODES = re.compile(r"\{(.*)\}")
_PARENT_CHECK_S = 0.2


class LocalPool(Pool):
    """Pool of worker processes on the caller's machine; a single worker is the caller's process.

    When a worker dies (e.g. killed because memory is short), loky ends all workers. Their tasks are then run again,
    one at a time, so that the task that kills its worker is identified.

    Args:
        n_workers: Number of processes.
        keep_workers: Whether processes continue after the last task, until `close` is called.
    """

    def __init__(self, n_workers: int, keep_workers: bool = False) -> None:
        self.n_workers, self._keep_workers = n_workers, keep_workers
        self._executor: ProcessPoolExecutor | None = None
        self._n_processes = 0

    def map_unordered(
        self, open_worker: OpenWorker[Task, Result], tasks: Sequence[Task], describe: Callable[[Task], str] = str
    ) -> Generator[tuple[int, Result], None, None]:
        """Apply a function to tasks, see `Pool.map_unordered`."""
        if min(self.n_workers, len(tasks)) <= 1:
            if tasks:
                with open_worker() as function:
                    for index, task in enumerate(tasks):
                        yield index, function(task)
            return
        job = uuid.uuid4().hex, pickle_by_value(Job(open_worker, describe))
        pending, suspects = dict(enumerate(tasks)), dict[int, Task]()
        while pending:
            chosen = suspects or pending
            n_workers = 1 if suspects else min(self.n_workers, len(pending))
            running: dict[Future[bytes], int] = {}
            try:
                for index, result in self._run_tasks(job, dict(chosen), n_workers, running):
                    del pending[index]
                    yield index, result
                suspects = {}
            except BrokenProcessPool as error:
                listed = ", ".join(describe(pending[index]) for index in running.values())
                match = _EXIT_CODES.search(str(error))
                reason = f"exit code {match[1]}" if match else type(error).__name__
                if suspects:
                    raise WorkerError(
                        f"a worker process died twice while {listed} ({reason}); finished results are kept. Use fewer "
                        "workers if memory is short, or workers=1 to see the failure in this process."
                    ) from error
                warnings.warn(
                    f"a worker process died ({reason}) while {listed}; retrying", RuntimeWarning, stacklevel=2
                )
                suspects = {index: pending[index] for index in running.values()}

    def close(self) -> None:
        """End the processes, even in the middle of a task."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None

    def _run_tasks(
        self, job: tuple[str, bytes], tasks: dict[int, Any], n_workers: int, running: dict[Future[bytes], int]
    ) -> Generator[tuple[int, Any], None, None]:
        """Run tasks in processes and yield (index, result) as tasks finish.

        No more tasks are submitted than workers exist, so that those in `running` are the ones that ran when a worker
        died.
        """
        executor = self._get_executor(n_workers)
        waiting = list(reversed(tasks))
        is_finished = False
        try:
            while waiting or running:
                while waiting and len(running) < n_workers:
                    task = pickle_by_value(tasks[waiting[-1]])
                    running[executor.submit(_run_task, *job, task)] = waiting.pop()
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    answer = future.result()
                    yield running.pop(future), unpickle_result(answer)
            is_finished = True
        finally:
            if not (is_finished and self._keep_workers):
                self.close()

    def _get_executor(self, n_workers: int) -> ProcessPoolExecutor:
        """Return the running processes, or start new ones if there are not enough."""
        if self._executor is None or self._n_processes < n_workers:
            self.close()
            self._executor = ProcessPoolExecutor(n_workers, initializer=_start_worker)
            self._n_processes = n_workers
        return self._executor


def _start_worker() -> None:
    """Prepare the current process as a worker.

    Ctrl-C is left to the main process, which ends its workers. A worker exits when the main process is gone, even in
    the middle of a task.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, args=(os.getppid(),), daemon=True).start()


def _exit_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_CHECK_S)
    os._exit(1)


def _run_task(job_id: str, pickled_job: bytes, pickled_task: bytes) -> bytes:
    return run_pickled_task(job_id, lambda: pickled_job, pickled_task)


def open_pool(config: PoolConfig, keep_workers: bool = False) -> Pool:
    """Return a worker pool with a configuration; for Ray, connect to the cluster.

    Args:
        config: Configuration of the pool.
        keep_workers: Whether local processes continue after the last task, until the pool is closed.

    Raises:
        UnknownNameError: The backend is unknown.
        OptionError: The configuration is invalid.
        WorkerError: The Ray cluster cannot be reached.
    """
    check_pool(config)
    if config.backend == RAY:
        # Imported only here, because Ray is an optional dependency.
        from handover_marl.execution.ray_pool import RayPool

        return RayPool(config)
    return LocalPool(resolve_worker_count(config.workers), keep_workers)


@contextmanager
def share_pool(config: PoolConfig) -> Iterator[Callable[[], Pool]]:
    """Yield a function that returns a pool whose processes are used for several jobs, and end at the exit.

    The pool is opened at the first call.

    Raises:
        HandoverError: As `open_pool`, at the first call.
    """
    with ExitStack() as stack:
        yield functools.cache(lambda: stack.enter_context(closing(open_pool(config, keep_workers=True))))


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
