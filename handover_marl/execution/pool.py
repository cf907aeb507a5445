"""Pools of workers on this machine or on a Ray cluster, which apply a function to tasks.

Processes on this machine are started by the library loky. Unlike with multiprocessing, the caller's script is not
imported again in the workers, so that it needs no `if __name__ == "__main__"`. Ray is optional: methods import it.
"""

import functools
import os
import re
import signal
import socket
import sys
import threading
import time
import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, nullcontext
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import node
from typing import Any, TypeAlias

from loky.process_executor import ProcessPoolExecutor

from handover_marl.errors import WorkerError
from handover_marl.execution.options import PoolConfig, require_modules, resolve_worker_count
from handover_marl.execution.tasks import (
    OpenWorker,
    Result,
    Task,
    pickle_by_value,
    pickle_result,
    run_pickled_task,
    unpickle_result,
)
from handover_marl.version import __version__

_EXIT_CODES = re.compile(r"\{(.*)\}")
_PARENT_CHECK_S = 0.2
# Packages whose versions can change bits of results.
_PACKAGES = ("numpy", "scipy", "pybullet", "pybullet-arm64", "mujoco")
_CONNECTION_TIMEOUT_S = 20.0


class Pool:
    """Pool of worker processes on this machine; a single worker, or a single task, runs in the caller's process.

    Attributes:
        n_workers: Number of tasks that run at a time.
        location: Location of the workers as text, e.g. "on a Ray cluster"; "" for this machine.
        is_remote: Whether workers may run on machines that share no files with the main machine.
    """

    location: str = ""
    is_remote: bool = False

    def __init__(self, n_workers: int) -> None:
        self.n_workers = n_workers
        self._executor: ProcessPoolExecutor | None = None
        self._n_processes = 0

    def map_unordered(
        self, open_worker: OpenWorker[Task, Result], tasks: Sequence[Task], describe: Callable[[Task], str] = str
    ) -> Generator[tuple[int, Result], None, None]:
        """Apply a function to tasks and yield (index in `tasks`, result) as tasks finish.

        Functions and classes of scripts and notebooks are sent by value. Closing the generator ends all running tasks.
        Errors of the function are raised here. In a worker process, errors that are not of this library, and the death
        of the process, become `WorkerError`.

        Args:
            open_worker: Function that returns a context manager, which yields the function to apply. Each worker
                process enters the context once, before its first task.
            tasks: Picklable arguments of the function.
            describe: Function that describes a task for messages, e.g. as "simulating scene 209".
        """
        if min(self.n_workers, len(tasks)) <= 1:
            if tasks:
                with open_worker() as function:
                    for index, task in enumerate(tasks):
                        yield index, function(task)
            return
        job = uuid.uuid4().hex, pickle_by_value((open_worker, describe))
        n_workers = min(self.n_workers, len(tasks))
        if self._executor is None or self._n_processes < n_workers:
            self.close()
            self._executor, self._n_processes = ProcessPoolExecutor(n_workers, initializer=_start_worker), n_workers
        waiting, running = list(reversed(range(len(tasks)))), dict[Future[bytes], int]()
        try:
            while waiting or running:
                # At most one task a process, so that the error names only tasks that ran when a process died.
                while waiting and len(running) < n_workers:
                    pickled = pickle_by_value(tasks[waiting[-1]])
                    running[self._executor.submit(run_pickled_task, *job, pickled)] = waiting.pop()
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    answer = future.result()
                    yield running.pop(future), unpickle_result(answer)
        except BrokenProcessPool as error:
            self.close()
            match = _EXIT_CODES.search(str(error))
            raise WorkerError(
                f"a worker process died while {', '.join(describe(tasks[index]) for index in running.values())} "
                f"({f'exit code {match[1]}' if match else type(error).__name__}); results in an output folder are "
                "kept, and the same call continues. Use fewer workers if memory is short, or workers=1 to see the "
                "failure in this process."
            ) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the processes, even in the middle of a task."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
            self._executor = None


def _start_worker() -> None:
    """Prepare the current process as a worker.

    Ctrl-C is left to the main process, which ends its workers. A worker exits at once when the main process is gone.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()

    def exit_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_CHECK_S)
        os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()


class RayPool:
    """Pool of workers on the Ray cluster at `address`, with the interface of `Pool`; nodes may join and leave.

    Each task runs on one core, and once more if the task's process or node dies. At most `workers` tasks run at a time;
    None means one per core of the cluster. An existing connection of this process to Ray is used; a new one stays open.
    """

    location = "on a Ray cluster"
    is_remote = True

    def __init__(self, workers: int | None, address: str) -> None:
        self._workers, self._address = workers, address

    @functools.cached_property
    def n_workers(self) -> int:
        """Number of tasks that run at a time; the first query connects this process to the cluster."""
        import ray

        if not ray.is_initialized():
            address = self._address
            if address == "auto":
                address = os.environ.get("RAY_ADDRESS", address)
            try:
                _check_server(address)
                ray.init(address, include_dashboard=False, logging_level="error")
            except Exception as error:  # Ray raises exceptions of several packages
                raise WorkerError(
                    f"Ray cannot be reached at {address} ({type(error).__name__}: {error}); start it there "
                    "(ray start --head), or pass ray_address='local' for a Ray on this machine"
                ) from error
        cores = int(ray.cluster_resources().get("CPU", 0))
        return max(1, cores) if self._workers is None else resolve_worker_count(self._workers)

    def map_unordered(
        self, open_worker: OpenWorker[Task, Result], tasks: Sequence[Task], describe: Callable[[Task], str] = str
    ) -> Generator[tuple[int, Result], None, None]:
        """Apply a function to tasks on the cluster, see `Pool.map_unordered`."""
        n_workers = self.n_workers
        import ray
        from ray.exceptions import NodeDiedError, ObjectLostError, RayError, WorkerCrashedError

        # Kept in the cluster's object store, so that it is sent to each node once.
        job = uuid.uuid4().hex, ray.put(pickle_by_value((open_worker, describe)))
        here = get_installed_versions(), list(map(str, sys.path))
        submit = ray.remote(num_cpus=1, max_retries=1, scheduling_strategy="SPREAD")(run_ray_task).remote
        waiting = list(reversed(range(len(tasks))))
        running: dict[Any, int] = {}
        try:
            while waiting or running:
                while waiting and len(running) < n_workers:
                    index = waiting.pop()
                    running[submit(*here, *job, pickle_by_value(tasks[index]))] = index
                ((reference, *_), _) = ray.wait(list(running))
                try:
                    answer = ray.get(reference)
                except (NodeDiedError, ObjectLostError, WorkerCrashedError) as error:
                    raise WorkerError(
                        f"a worker process died twice while {describe(tasks[running[reference]])} "
                        f"({type(error).__name__}); finished results are kept. Use fewer workers if memory is short, "
                        "or workers=1 without Ray to see the failure in this process."
                    ) from error
                except RayError as error:
                    last_line = str(error).strip().splitlines()[-1]
                    raise WorkerError(
                        f"Ray could not run a task ({last_line}); every node needs handover_marl {__version__} "
                        "with the same extras as this machine"
                    ) from error
                yield running.pop(reference), unpickle_result(answer)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)

    def close(self) -> None:
        """Do nothing: the processes are Ray's."""


def run_ray_task(
    versions: Mapping[str, str], search_path: Sequence[str], job_id: str, pickled_job: bytes, pickled_task: bytes
) -> bytes:
    """Run a task of a job in a worker process of Ray and return its pickled result, see `run_pickled_task`.

    The result is a pickled `WorkerError` if the node's packages differ from the main machine's `versions`. The main
    machine's import path, `search_path`, is searched last.
    """
    installed = get_installed_versions()
    different = [f"{name} {installed[name]} there, {wanted} here" for name, wanted in versions.items()
                 if installed[name] != wanted]  # fmt: skip
    if different:
        return pickle_result(
            WorkerError(
                f"node {node()} has other versions ({'; '.join(different)}), so that its results might "
                "differ; install the same versions on every node"
            )
        )
    sys.path += [path for path in search_path if path not in sys.path and Path(path).exists()]
    return run_pickled_task(job_id, pickled_job, pickled_task)


def get_installed_versions() -> dict[str, str]:
    """Return the versions of this library and of packages that affect results, by name; "none" if not installed."""
    found = {"handover_marl": __version__}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _check_server(address: str) -> None:
    """Raise OSError if no server listens at "host:port" or "ray://host:port"; ignore other addresses such as "auto".

    Ray itself would try to connect for a quarter of an hour.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _CONNECTION_TIMEOUT_S).close()


AnyPool: TypeAlias = Pool | RayPool


def open_pool(config: PoolConfig) -> AnyPool:
    """Return a worker pool, which the caller must close; it starts processes or connects to Ray for its first task."""
    n_workers = resolve_worker_count(config.workers)
    if config.ray_address is None:
        return Pool(n_workers)
    require_modules("ray_address", "ray", "ray", advice="; or leave it out")
    return RayPool(config.workers, config.ray_address)


def map_with_progress(
    make_function: Callable[[], Callable[[Task], Result]],
    tasks: Sequence[Task],
    description: str,
    config: PoolConfig,
    progress: bool,
) -> Generator[tuple[Task, Result], None, None]:
    """Apply a function to tasks in worker processes and yield (task, result) as tasks finish, with a progress bar.

    Args:
        make_function: Function that makes the function to apply; called once in each worker process.
        tasks: Picklable arguments of the function.
        description: Label of the progress bar.
        config: Configuration of the worker pool.
        progress: Whether to show the progress bar on stderr.
    """
    # Imported here: rich draws random numbers when it is imported, and policies import this module.
    from rich.console import Console
    from rich.progress import track

    with closing(open_pool(config)) as pool:
        finished = pool.map_unordered(
            lambda: nullcontext(make_function()), tasks, lambda task: f"{description}: {str(task)[:80]}"
        )
        bar = track(finished, description, len(tasks), console=Console(stderr=True), disable=not progress)
        for index, result in bar:
            yield tasks[index], result
