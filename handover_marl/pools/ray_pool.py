"""Workers on the nodes of a Ray cluster: an actor each, on a core of its own.

Nodes may come and go. A worker that is gone is replaced wherever there is a free core; until there is one the others
go on. If this process is connected to Ray already, that connection is used; one that is made here lasts as long as it.
"""

import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import node
from typing import Any

import cloudpickle

from handover_marl._version import __version__
from handover_marl.errors import WorkerError
from handover_marl.options import check_workers
from handover_marl.pools.pool import Job, Pool, Ready, Worker, WorkerGoneError
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.service import Service

# What results to the bit depend on, besides this library.
_PACKAGES = ("numpy", "scipy", "pybullet", "mujoco")
# Where it is missing, physics that need it say so; all others are the same without.
_OPTIONAL, _MISSING = ("mujoco",), "none"
_PATIENCE = 30.0  # s without any worker before it is told


@dataclass(frozen=True)
class Hello:
    """What a worker on a node says of itself.

    Attributes:
        node: Ray's number of the node.
        host: Its name.
        versions: Of this library and what its results depend on.
    """

    node: str
    host: str
    versions: dict[str, str]


class RayService:
    """What an actor is.

    Args:
        job: The job, pickled.
        search_path: Where the caller's modules are; what of it is there is looked through last.
    """

    def __init__(self, job: bytes, search_path: list[str]) -> None:
        sys.path += [path for path in search_path if path not in sys.path and Path(path).exists()]
        self._service = Service(job)

    def hello(self) -> Hello:
        """Where this is."""
        import ray

        return Hello(ray.get_runtime_context().get_node_id(), node(), versions())

    def answer(self, task: bytes) -> bytes:
        """As `Service.answer`."""
        return self._service.answer(task)


class RayPool(Pool):
    """Actors of a Ray cluster.

    Args:
        config: How many, and of which.

    Raises:
        WorkerError: There is no such cluster.
    """

    place = "on a Ray cluster"
    elsewhere = True

    def __init__(self, config: PoolConfig) -> None:
        import ray

        if not ray.is_initialized():
            try:
                ray.init(config.address, include_dashboard=False, logging_level="error")
            except Exception as error:  # whatever Ray meets, with types of several packages
                raise WorkerError(
                    f"Ray cannot be reached at {config.address or 'the default address'} ({type(error).__name__}: "
                    f"{error}); start it there (ray start --head), or leave out ray_address for a Ray on this machine"
                ) from error
        cores = int(ray.cluster_resources().get("CPU", 0))
        self.size = max(1, cores) if config.workers is None else check_workers(config.workers)
        # Spread, so that few workers do not crowd on one node.
        self._kind = ray.remote(num_cpus=1, max_restarts=0, scheduling_strategy="SPREAD")(RayService)
        self._alone_since: float | None = None

    def order(self, job: Job[Any, Any]) -> Any:
        """As `Pool.order`: kept in the cluster, so that it goes to each node once."""
        import ray

        return ray.put(cloudpickle.dumps(job))

    def hire(self, order: Any) -> "RayWorker":
        """As `Pool.hire`."""
        return RayWorker(self._kind.remote(order, sys.path))

    def wait(self, workers: Sequence[Worker]) -> list[Worker]:
        """As `Pool.wait`; tells when the cluster has no core to spare."""
        import ray

        by_answer = {worker.answer: worker for worker in workers if isinstance(worker, RayWorker)}
        if any(worker.ready for worker in workers):
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        while True:
            # One after another: with all that are there at once, those that come last would wait for the others.
            there, _ = ray.wait(list(by_answer), num_returns=1, timeout=1.0)
            if there:
                return [by_answer[answer] for answer in there]
            if self._alone_since is not None and time.monotonic() - self._alone_since > _PATIENCE:
                self._alone_since = float("inf")
                warnings.warn(f"waiting for a free core of the Ray cluster ({_cores()})", RuntimeWarning, stacklevel=2)


class RayWorker(Worker):
    """An actor.

    Args:
        actor: Its handle.
    """

    ready = False

    def __init__(self, actor: Any) -> None:
        self._actor, self._hello = actor, Hello("", "a node", {})
        self.answer = actor.hello.remote()

    def give(self, task: Any) -> None:
        """As `Worker.give`."""
        self.answer = self._actor.answer.remote(cloudpickle.dumps(task))

    def heard(self) -> object:
        """As `Worker.heard`.

        Raises:
            WorkerError: The node has other versions, or not what a worker needs.
        """
        import ray
        from ray.exceptions import ActorDiedError, RayError, RayTaskError

        try:
            said = ray.get(self.answer)
        except ActorDiedError as error:
            if error.actor_init_failed:
                raise WorkerError(
                    f"a worker cannot start on {self._hello.host} ({_last_line(error)}); every node needs "
                    f"handover_marl {__version__} with the same extras as this machine"
                ) from error
            raise WorkerGoneError(f"{self._hello.host}: its process died", by_itself=self._node_lives()) from error
        except RayTaskError as error:
            raise WorkerError(f"a worker on {self._hello.host} failed ({_last_line(error)})") from error
        except RayError as error:
            # The node or the way to it is gone, with the answer that was on it.
            raise WorkerGoneError(f"{self._hello.host}: {type(error).__name__}", by_itself=False) from error
        if isinstance(said, Hello):
            self._hello = said
            check_versions(said)
            return Ready()
        return cloudpickle.loads(said)

    def dismiss(self) -> None:
        """As `Worker.dismiss`."""
        import ray

        ray.kill(self._actor, no_restart=True)

    def _node_lives(self) -> bool:
        import ray

        alive = {told["NodeID"] for told in ray.nodes() if told["Alive"]}
        return not self._hello.node or self._hello.node in alive


def versions() -> dict[str, str]:
    """Of this library and what its results depend on, here."""
    found = {"handover_marl": __version__}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = _MISSING
    return found


def check_versions(said: Hello) -> None:
    """Raise `WorkerError` if a node would give other results."""
    pairs = {name: (said.versions.get(name), here) for name, here in versions().items()}
    different = [
        f"{name} {there} there, {here} here"
        for name, (there, here) in pairs.items()
        if there != here and not (name in _OPTIONAL and _MISSING in (there, here))
    ]
    if different:
        raise WorkerError(
            f"node {said.host} has other versions ({'; '.join(different)}), so that its results might be others; "
            "install the same on every node"
        )


def _cores() -> str:
    import ray

    free, cores = (sources.get("CPU", 0.0) for sources in (ray.available_resources(), ray.cluster_resources()))
    return f"{free:g} of {cores:g} are free"


def _last_line(error: Exception) -> str:
    return str(error).strip().splitlines()[-1]
