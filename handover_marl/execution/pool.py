"""Worker pools, on this machine or a Ray cluster, and functions that apply them to tasks.

A job is a function that a process creates once and then applies to its tasks. Jobs, tasks and results are pickled by
value, so that functions and classes of scripts and notebooks work. Processes on this machine are started by the library
loky. Unlike with multiprocessing, the caller's script is not imported again in the workers, so that it needs no
`if __name__ == "__main__"`.

On a Ray cluster each task is run on one core. Nodes may join and leave. Ray runs a task once more when its process or
node dies. An existing connection of this process to Ray is used; a new one lasts as long as the process. Ray is
imported in functions, because it is an optional dependency.
"""

import functools
import os
import pickle
import re
import signal
import socket
import sys
import threading
import time
import traceback
import uuid
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import node
from typing import Any, ClassVar, TypeAlias, TypeVar

from loky import wrap_non_picklable_objects
from loky.process_executor import ProcessPoolExecutor

from handover_marl.errors import HandoverError, PolicyError, WorkerError
from handover_marl.execution.options import RAY, PoolConfig, check_pool, resolve_worker_count
from handover_marl.version import __version__

Task = TypeVar("Task")
Result = TypeVar("Result")
#: Factory of the function that a worker process applies to its tasks; entered once per process.
OpenWorker: TypeAlias = Callable[[], AbstractContextManager[Callable[[Task], Result]]]

_EXIT_CODES = re.compile(r"\{(.*)\}")
_PARENT_CHECK_S = 0.2
# Packages that results depend on bit for bit. The optional ones may be missing on a node: physics
# that need them raise an error there, and all others do not use them.
_PACKAGES = ("numpy", "scipy", "pybullet", "pybullet-arm64", "mujoco")
_OPTIONAL, _MISSING = ("mujoco",), "none"
_RETRIES = 1
_CONNECTION_TIMEOUT_S = 20.0


class Pool(ABC):
    """Base class of worker pools.

    Attributes:
        n_workers: Number of tasks that run at a time.
        location: Place where the workers run, e.g. "on a Ray cluster"; empty for this machine.
        is_remote: Whether workers may run on machines that share no files with the main machine.
    """

    n_workers: int
    location: str = ""
    is_remote: bool = False

    @abstractmethod
    def map_unordered(
        self, open_worker: OpenWorker[Task, Result], tasks: Sequence[Task], describe: Callable[[Task], str] = str
    ) -> Generator[tuple[int, Result], None, None]:
        """Apply a function to tasks and yield (index of the task, result) as tasks finish.

        Functions and classes of scripts and notebooks are sent by value. Closing the generator
        ends all tasks that still run.

        Args:
            open_worker: Returns a context manager that yields the function; entered once per
                worker process, before its first task.
            tasks: Picklable arguments of the function.
            describe: Short description of a task for messages, such as "simulating scene 209".

        Raises:
            WorkerError: A worker process died twice over the same task, or a task failed with an
                error that is not one of this library.
            HandoverError: A task failed with this error of the library.
        """

    def close(self) -> None:  # noqa: B027
        """End worker processes that the pool has kept."""


class _ProcessState:
    """State of a worker process: its present job, and the function that the job has created."""

    job_id: ClassVar[str] = ""
    job: ClassVar[tuple[OpenWorker[Any, Any], Callable[[Any], str]]]
    function: ClassVar[Callable[[Any], Any] | None] = None
    resources: ClassVar[ExitStack] = ExitStack()


def pickle_by_value(value: object) -> bytes:
    """Return a pickled value, with the code of functions and classes that another process cannot import."""
    return pickle.dumps(wrap_non_picklable_objects((value,), keep_wrapper=False))


def unpickle(pickled: bytes) -> Any:
    """Return the value that `pickle_by_value` pickled."""
    (value,) = pickle.loads(pickled)
    return value


def run_pickled_task(job_id: str, load_job: Callable[[], bytes], pickled_task: bytes) -> bytes:
    """Run a task of a job in the current process and return its result, or the error that ended it, pickled.

    Args:
        job_id: Unique label of the job; the resources of another job are freed.
        load_job: Function that returns the job, the pair (open_worker, describe), pickled by `pickle_by_value`.
        pickled_task: Task, pickled likewise.
    """
    state, description = _ProcessState, "a task"
    try:
        if state.job_id != job_id:
            state.function = None
            state.resources.close()
            state.job_id, state.job = job_id, unpickle(load_job())
        task = unpickle(pickled_task)
        open_worker, describe = state.job
        description = describe(task)
        if state.function is None:
            state.function = state.resources.enter_context(open_worker())
        answer: object = state.function(task)
    except PolicyError as error:
        # The cause is lost when an exception is pickled, so its traceback goes into the text.
        answer = PolicyError(f"{error}\n{traceback.format_exc()}")
    except HandoverError as error:
        answer = error
    except Exception as error:
        # As text, since the class of a foreign exception may not exist in the main process.
        answer = WorkerError(f"{description}: {type(error).__name__}: {error}\n{traceback.format_exc()}")
    return pickle_result(answer)


def pickle_result(result: object) -> bytes:
    """Return the pickled result of a task, or the error that ended it."""
    try:
        return pickle_by_value(result)
    except Exception as error:  # pickling a user's object may raise anything
        message = f"a task's result cannot be pickled ({type(error).__name__}: {error})"
        return pickle_by_value(WorkerError(message))


def unpickle_result(pickled: bytes) -> Any:
    """Return the result of a task from `run_pickled_task`.

    Raises:
        HandoverError: The task failed.
    """
    result = unpickle(pickled)
    if isinstance(result, HandoverError):
        raise result
    return result


def make_picklable(error: Exception) -> Exception:
    """Return an error, or a `WorkerError` with its message if the error cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return WorkerError(f"{type(error).__name__}: {error}")
    return error


class LocalPool(Pool):
    """Pool of worker processes on the caller's machine; a single worker is the caller's process.

    When a worker dies (e.g. killed because memory is short), loky ends all workers. Their tasks are then run again,
    one at a time, so that the task that kills its worker is identified.

    Args:
        n_workers: Number of processes.
    """

    def __init__(self, n_workers: int) -> None:
        self.n_workers = n_workers
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
        job = uuid.uuid4().hex, pickle_by_value((open_worker, describe))
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
            if not is_finished:
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


class RayPool(Pool):
    """Pool of workers on a Ray cluster.

    Args:
        config: Number of tasks that run at a time, and the cluster's address.
    """

    location = "on a Ray cluster"
    is_remote = True

    def __init__(self, config: PoolConfig) -> None:
        self._config = config

    @functools.cached_property
    def n_workers(self) -> int:  # type: ignore[override]
        """Number of tasks that run at a time, on the cluster to which this connects.

        Raises:
            WorkerError: The cluster cannot be reached.
        """
        import ray

        config = self._config
        if not ray.is_initialized():
            address = config.ray_address or os.environ.get("RAY_ADDRESS")
            try:
                _check_server(address or "")
                ray.init(config.ray_address, include_dashboard=False, logging_level="error")
            except Exception as error:  # Ray raises exceptions of several packages
                raise WorkerError(
                    f"Ray cannot be reached at {address or 'the default address'} "
                    f"({type(error).__name__}: {error}); start it there (ray start --head), or "
                    "leave out ray_address for a Ray on this machine"
                ) from error
        cores = int(ray.cluster_resources().get("CPU", 0))
        return max(1, cores) if config.workers is None else resolve_worker_count(config.workers)

    def map_unordered(
        self, open_worker: OpenWorker[Task, Result], tasks: Sequence[Task], describe: Callable[[Task], str] = str
    ) -> Generator[tuple[int, Result], None, None]:
        """Apply a function to tasks on the cluster, see `Pool.map_unordered`."""
        import ray

        n_workers = self.n_workers
        # Kept in the cluster's object store, so that it is sent to each node once.
        job = ray.put(pickle_by_value((open_worker, describe)))
        spread = ray.remote(num_cpus=1, max_retries=_RETRIES, scheduling_strategy="SPREAD")
        job_arguments = ([job], uuid.uuid4().hex, get_installed_versions(), list(map(str, sys.path)))
        submit = spread(run_ray_task).remote
        waiting = list(reversed(range(len(tasks))))
        running: dict[Any, int] = {}
        try:
            while waiting or running:
                while waiting and len(running) < n_workers:
                    index = waiting.pop()
                    running[submit(*job_arguments, pickle_by_value(tasks[index]))] = index
                ((reference, *_), _) = ray.wait(list(running))
                answer = _get(reference, describe(tasks[running[reference]]))
                yield running.pop(reference), unpickle_result(answer)
        finally:
            for reference in running:
                ray.cancel(reference, force=True)


def run_ray_task(
    job: list[Any], job_id: str, versions: Mapping[str, str], search_path: Sequence[str], task: bytes
) -> bytes:
    """Run a task of a job in a worker process of Ray and return its pickled result.

    Args:
        job: Reference of the pickled job in Ray's object store, in a list so that Ray does not
            fetch it for every task.
        job_id: Unique label of the job.
        versions: Versions of the packages on the main process's machine.
        search_path: Import path of the main process; folders that exist here are searched last.
        task: Pickled task.
    """
    import ray

    def load_job() -> bytes:
        sys.path += [path for path in search_path if path not in sys.path and Path(path).exists()]
        pickled: bytes = ray.get(job[0])
        return pickled

    try:
        check_versions(versions, get_installed_versions())
    except WorkerError as error:
        return pickle_result(error)
    return run_pickled_task(job_id, load_job, task)


def get_installed_versions() -> dict[str, str]:
    """Return the versions of this library and of the packages that results depend on."""
    found = {"handover_marl": __version__}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = _MISSING
    return found


def check_versions(expected: Mapping[str, str], installed: Mapping[str, str]) -> None:
    """Check that a node has the same versions of packages as the main process.

    Args:
        expected: Versions on the main process's machine.
        installed: Versions on this node.

    Raises:
        WorkerError: A version differs.
    """
    different = [
        f"{name} {installed.get(name)} there, {wanted} here"
        for name, wanted in expected.items()
        if installed.get(name) != wanted and not (name in _OPTIONAL and _MISSING in (installed.get(name), wanted))
    ]
    if different:
        raise WorkerError(
            f"node {node()} has other versions ({'; '.join(different)}), so that its results might "
            "differ; install the same versions on every node"
        )


def _get(reference: Any, description: str) -> bytes:
    import ray
    from ray.exceptions import NodeDiedError, ObjectLostError, RayError, WorkerCrashedError

    try:
        answer: bytes = ray.get(reference)
    except (NodeDiedError, ObjectLostError, WorkerCrashedError) as error:
        raise WorkerError(
            f"a worker process died twice while {description} ({type(error).__name__}); finished "
            "results are kept. Use fewer workers if memory is short, or workers=1 without Ray to "
            "see the failure in this process."
        ) from error
    except RayError as error:
        last_line = str(error).strip().splitlines()[-1]
        raise WorkerError(
            f"Ray could not run a task ({last_line}); every node needs handover_marl {__version__} "
            "with the same extras as this machine"
        ) from error
    return answer


def _check_server(address: str) -> None:
    """Check that something listens at an address; Ray itself would try for a quarter of an hour.

    Args:
        address: "host:port" or "ray://host:port"; other addresses such as "auto" are left to Ray.

    Raises:
        OSError: Nothing listens.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _CONNECTION_TIMEOUT_S).close()


def open_pool(config: PoolConfig) -> Pool:
    """Return a worker pool with a configuration; close it after its last job.

    Processes are started, and Ray clusters connected to, for the first task.

    Raises:
        UnknownNameError: The backend is unknown.
        OptionError: The configuration is invalid.
    """
    check_pool(config)
    return RayPool(config) if config.backend == RAY else LocalPool(resolve_worker_count(config.workers))


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
