"""What every pool of workers offers, wherever they are: workers that take one task at a time."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Task = TypeVar("Task")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Job(Generic[Task, Answer]):
    """What workers do. It is sent to them by value, so that functions of a script or a notebook will do.

    Attributes:
        prepare: Called once by every worker, before its first task. Within what it gives, tasks are done by calling
            it; it is closed when there are no more.
        words: A task in words, such as "playing scene 209".
    """

    prepare: Callable[[], AbstractContextManager[Callable[[Task], Answer]]]
    words: Callable[[Task], str]


@dataclass(frozen=True)
class Failed:
    """Why a task was not done: an error of this library, as it would have come up in the caller's process."""

    error: Exception


class Ready:
    """What a worker says when it can take its first task."""


class WorkerGoneError(Exception):
    """A worker is gone.

    Args:
        reason: In words.
        by_itself: Whether it may be its task's fault: the process died, and not the machine that it was on.
    """

    def __init__(self, reason: str, by_itself: bool) -> None:
        super().__init__(reason)
        self.by_itself = by_itself


class Worker(ABC):
    """A process that does one task at a time.

    Attributes:
        ready: Whether it can be given tasks; one that is not will say `Ready`.
        task: Number of the task that it does, or None.
    """

    ready: bool = True
    task: int | None = None

    @abstractmethod
    def give(self, task: Any) -> None:
        """Let it do a task. That it is gone shows when it is heard."""

    @abstractmethod
    def heard(self) -> object:
        """What it says, once the pool's `wait` has named it: `Ready`, `Failed`, or the answer to its task.

        Raises:
            WorkerGoneError: It will say nothing any more.
            HandoverError: It can never be used.
        """

    @abstractmethod
    def dismiss(self) -> None:
        """Tell it to end, without waiting until it has."""

    def end(self) -> None:  # noqa: B027
        """Wait until it has ended, and end it by force if it takes long."""


class Pool(ABC):
    """Where workers come from.

    Attributes:
        size: How many there are to be.
        place: What to say of them beside their number, e.g. "on a Ray cluster"; empty for this machine.
        elsewhere: Whether they may be on machines that share no files with this one.
    """

    size: int
    place: str = ""
    elsewhere: bool = False

    @abstractmethod
    def order(self, job: Job[Any, Any]) -> Any:
        """A job as workers are told it."""

    @abstractmethod
    def hire(self, order: Any) -> Worker:
        """A new worker."""

    @abstractmethod
    def wait(self, workers: Sequence[Worker]) -> list[Worker]:
        """Wait until at least one of some workers has something to say; those that have."""
