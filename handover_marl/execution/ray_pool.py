"""Worker pool on a Ray cluster.

Each task is run on one core. Nodes may join and leave. Ray runs a task once more when its process or node dies. An
existing connection of this process to Ray is used; a new one lasts as long as the process. Ray, an optional dependency,
is imported in functions.
"""

import functools
import os
import socket
import sys
import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import node
from typing import Any

from handover_marl.errors import WorkerError
from handover_marl.execution.options import PoolConfig, resolve_worker_count
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

# Packages that results depend on bit for bit.
_PACKAGES = ("numpy", "scipy", "pybullet", "pybullet-arm64", "mujoco")
_RETRIES = 1
_CONNECTION_TIMEOUT_S = 20.0


class RayPool:
    """Pool of workers on a Ray cluster; see `handover_marl.execution.pool.Pool`.

    Args:
        config: Number of tasks that run at a time, and the cluster's address.
    """

    location = "on a Ray cluster"
    is_remote = True

    def __init__(self, config: PoolConfig) -> None:
        self._config = config

    @functools.cached_property
    def n_workers(self) -> int:
        """Number of tasks that run at a time; the first query connects this process to the cluster.

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
        n_workers = self.n_workers
        import ray
        from ray.exceptions import NodeDiedError, ObjectLostError, RayError, WorkerCrashedError

        # Kept in the cluster's object store, so that it is sent to each node once.
        job = uuid.uuid4().hex, ray.put(pickle_by_value((open_worker, describe)))
        here = get_installed_versions(), list(map(str, sys.path))
        submit = ray.remote(num_cpus=1, max_retries=_RETRIES, scheduling_strategy="SPREAD")(run_ray_task).remote
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
    """Run a task of a job in a worker process of Ray and return its pickled result.

    Args:
        versions: Versions of the packages on the main process's machine, which this node must have.
        search_path: Import path of the main process; folders that exist here are searched last.
        job_id: Unique label of the job.
        pickled_job: Job, see `run_pickled_task`.
        pickled_task: Task, see `run_pickled_task`.
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
    """Return the versions of this library and of packages that results depend on, by name; "none" if missing."""
    found = {"handover_marl": __version__}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _check_server(address: str) -> None:
    """Check that something listens at "host:port" or "ray://host:port"; Ray itself would try for a quarter of an hour.

    Other addresses such as "auto" are left to Ray.

    Raises:
        OSError: Nothing listens.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _CONNECTION_TIMEOUT_S).close()
