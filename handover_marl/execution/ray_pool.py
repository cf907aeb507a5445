"""Worker processes on the nodes of a Ray cluster; each task is run on one core.

Nodes may join and leave. Ray runs a task once more when its process or node dies. An
existing connection of this process to Ray is used; a new connection lasts as long as the process.
"""

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
from handover_marl.execution.pool import (
    Job,
    OpenWorker,
    Pool,
    Result,
    Task,
    pickle_by_value,
    pickle_result,
    run_pickled_task,
    unpickle_result,
)
from handover_marl.version import __version__

# Packages that results depend on bit for bit. The optional ones may be missing on a node: physics
# that need them raise an error there, and all others do not use them.
_PACKAGES = ("numpy", "scipy", "pybullet", "pybullet-arm64", "mujoco")
_OPTIONAL, _MISSING = ("mujoco",), "none"
_RETRIES = 1
_CONNECTION_TIMEOUT_S = 20.0


class RayPool(Pool):
    """Pool of workers on a Ray cluster.

    Args:
        config: Number of tasks that run at a time, and the cluster's address.

    Raises:
        WorkerError: The cluster cannot be reached.
    """

    location = "on a Ray cluster"
    is_remote = True

    def __init__(self, config: PoolConfig) -> None:
        import ray

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
        self.n_workers = max(1, cores) if config.workers is None else resolve_worker_count(config.workers)

    def map_unordered(
        self, open_worker: OpenWorker[Task, Result], tasks: Sequence[Task], describe: Callable[[Task], str] = str
    ) -> Generator[tuple[int, Result], None, None]:
        """Apply a function to tasks on the cluster, see `Pool.map_unordered`."""
        import ray

        # Kept in the cluster's object store, so that it is sent to each node once.
        job = ray.put(pickle_by_value(Job(open_worker, describe)))
        spread = ray.remote(num_cpus=1, max_retries=_RETRIES, scheduling_strategy="SPREAD")
        job_arguments = ([job], uuid.uuid4().hex, get_installed_versions(), list(map(str, sys.path)))
        submit = spread(run_ray_task).remote
        waiting = list(reversed(range(len(tasks))))
        running: dict[Any, int] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self.n_workers:
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
