"""Configuration and base class of worker pools (local processes or Ray)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

from handover_marl.errors import OptionError, check_name
from handover_marl.execution.options import require_modules, resolve_worker_count

LOCAL, RAY = "local", "ray"
BACKENDS = (LOCAL, RAY)

Task = TypeVar("Task")
Result = TypeVar("Result")
#: Factory of the function that a worker process applies to its tasks; entered once per process.
OpenWorker: TypeAlias = Callable[[], AbstractContextManager[Callable[[Task], Result]]]


@dataclass(frozen=True)
class PoolConfig:
    """Configuration of a worker pool.

    Attributes:
        workers: Number of worker processes; None for one per core of this machine or of the cluster.
        backend: "local" for processes of this machine, or "ray".
        address: Address of the Ray cluster, as `ray.init` takes it; None lets Ray find or start one.
    """

    workers: int | None = None
    backend: str = LOCAL
    address: str | None = None

    def check(self) -> None:
        """Check that a pool with this configuration can be started, without starting it.

        Raises:
            UnknownNameError: The backend is unknown.
            OptionError: The number of workers is invalid, Ray is not installed, or an address is
                given without Ray.
        """
        check_name("backend", self.backend, BACKENDS)
        resolve_worker_count(self.workers)
        if self.backend == RAY:
            require_modules("backend 'ray'", "ray", "ray", advice="; or leave out `backend`")
        if self.backend != RAY and self.address is not None:
            raise OptionError(
                "ray_address must be used with backend='ray', got "
                f"{self.address!r} with backend {self.backend!r}; pass backend='ray'"
            )


@dataclass(frozen=True)
class Job(Generic[Task, Result]):
    """Function that worker processes apply to tasks; pickled by value.

    Attributes:
        open_worker: Factory of the function, entered once per process before its first task.
        describe: Short description of a task for messages, such as "simulating scene 209".
    """

    open_worker: OpenWorker[Task, Result]
    describe: Callable[[Task], str]


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
