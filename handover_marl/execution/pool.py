"""Base class of worker pools (local processes or Ray), and the function that they apply to tasks."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
#: Factory of the function that a worker process applies to its tasks; entered once per process.
OpenWorker: TypeAlias = Callable[[], AbstractContextManager[Callable[[Task], Result]]]


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

    @abstractmethod
    def close(self) -> None:
        """End worker processes that the pool has kept."""
