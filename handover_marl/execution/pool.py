"""Base class of worker pools (local processes or Ray), and the work of their processes.

A job is a function that a process creates once and then applies to its tasks. Jobs, tasks and results are pickled by
value, so that functions and classes of scripts and notebooks work.
"""

import pickle
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

from loky import wrap_non_picklable_objects

from handover_marl.errors import HandoverError, PolicyError, WorkerError

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

    def close(self) -> None:  # noqa: B027
        """End worker processes that the pool has kept."""


class _ProcessState:
    """State of a worker process: its present job, and the function that the job has created."""

    job_id: ClassVar[str] = ""
    job: ClassVar[Job[Any, Any]]
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
        load_job: Function that returns the job, pickled by `pickle_by_value`.
        pickled_task: Task, pickled likewise.
    """
    state, description = _ProcessState, "a task"
    try:
        if state.job_id != job_id:
            state.function = None
            state.resources.close()
            state.job_id, state.job = job_id, unpickle(load_job())
        task = unpickle(pickled_task)
        description = state.job.describe(task)
        if state.function is None:
            state.function = state.resources.enter_context(state.job.open_worker())
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
