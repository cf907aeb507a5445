"""Tasks that worker processes run.

For each job, a process makes one function and then applies it to the tasks of the job. Jobs, tasks and results are
pickled by value, so that functions and classes of scripts and notebooks work.
"""

import pickle
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any, ClassVar, TypeAlias, TypeVar

from loky import wrap_non_picklable_objects

from handover_marl.errors import HandoverError, PolicyError, WorkerError

Task = TypeVar("Task")
Result = TypeVar("Result")
#: Function that returns a context manager, which yields the function to apply to tasks; entered once per process.
OpenWorker: TypeAlias = Callable[[], AbstractContextManager[Callable[[Task], Result]]]


class _ProcessState:
    """State of a worker process: its present job, see `run_pickled_task`, and the function to apply to the tasks."""

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


def run_pickled_task(job_id: str, pickled_job: bytes, pickled_task: bytes) -> bytes:
    """Run a task of a job in the current process; return the pickled result, or the pickled error of the task.

    A job is a pair (open_worker, describe), see `Pool.map_unordered`. The first task of a job enters the context of
    `open_worker`, after the context of the previous job has been closed.
    """
    state, description = _ProcessState, "a task"
    try:
        if state.job_id != job_id:
            state.function = None
            state.resources.close()
            state.job_id, state.job = job_id, unpickle(pickled_job)
        task = unpickle(pickled_task)
        open_worker, describe = state.job
        description = describe(task)
        if state.function is None:
            state.function = state.resources.enter_context(open_worker())
        answer: object = state.function(task)
    except Exception as error:
        answer = convert_error(error, description)
    return pickle_result(answer)


def convert_error(error: Exception, description: str) -> HandoverError:
    """Return a picklable error in place of `error`, the one being handled; `description` is text on the failed task."""
    # The cause is lost when an exception is pickled, so its traceback goes into the text.
    if isinstance(error, PolicyError):
        return PolicyError(f"{error}\n{traceback.format_exc()}")
    if isinstance(error, HandoverError):
        return error
    # As text, since the class of a foreign exception may not exist in the main process.
    return WorkerError(f"{description}: {type(error).__name__}: {error}\n{traceback.format_exc()}")


def pickle_result(result: object) -> bytes:
    """Pickle a task's result, or the error that ended it; if that fails, pickle a `WorkerError` that says why."""
    try:
        return pickle_by_value(result)
    except Exception as error:  # pickling a user's object may raise anything
        message = f"a task's result cannot be pickled ({type(error).__name__}: {error})"
        return pickle_by_value(WorkerError(message))


def unpickle_result(pickled: bytes) -> Any:
    """Return the result that `run_pickled_task` pickled, or raise the error that ended the task."""
    result = unpickle(pickled)
    if isinstance(result, HandoverError):
        raise result
    return result
