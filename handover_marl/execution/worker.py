"""Worker processes of a pool: run tasks, and return results or errors as bytes."""

import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, ClassVar

import cloudpickle

from handover_marl.errors import HandoverError, PolicyError, WorkerError
from handover_marl.execution.pool import Job

_PARENT_CHECK_S = 0.2


@dataclass(frozen=True)
class TaskFailure:
    """Error that ended a task, sent to the main process in place of a result."""

    error: HandoverError


class JobRunner:
    """Runner of one job's tasks in a worker process.

    The job is unpickled and its function created at the first task.

    Args:
        pickled_job: A `Job`, pickled by cloudpickle.
    """

    def __init__(self, pickled_job: bytes) -> None:
        self._pickled_job = pickled_job
        self._job: Job[Any, Any] | None = None
        self._function: Callable[[Any], Any] | None = None
        self._resources = ExitStack()

    def run(self, pickled_task: bytes) -> bytes:
        """Run a task and return its result, or a `TaskFailure`, pickled."""
        try:
            answer: bytes = cloudpickle.dumps(self._compute(pickled_task))
        except Exception as error:  # pickling a user's object may raise anything
            message = f"a task's result cannot be pickled ({type(error).__name__}: {error})"
            answer = cloudpickle.dumps(TaskFailure(WorkerError(message)))
        return answer

    def close(self) -> None:
        """Free the resources of the job's function."""
        self._resources.close()

    def _compute(self, pickled_task: bytes) -> object:
        description = "a task"
        try:
            self._job = self._job or cloudpickle.loads(self._pickled_job)
            task = cloudpickle.loads(pickled_task)
            description = self._job.describe(task)
            if self._function is None:
                self._function = self._resources.enter_context(self._job.open_worker())
            return self._function(task)
        except PolicyError as error:
            # The cause is lost when an exception is pickled, so its traceback goes into the text.
            return TaskFailure(PolicyError(f"{error}\n{traceback.format_exc()}"))
        except HandoverError as error:
            return TaskFailure(error)
        except Exception as error:
            # As text, since the class of a foreign exception may not exist in the main process.
            message = f"{description}: {type(error).__name__}: {error}\n{traceback.format_exc()}"
            return TaskFailure(WorkerError(message))


def unpickle_result(answer: bytes) -> Any:
    """Return the result that `JobRunner.run` pickled.

    Raises:
        HandoverError: The task failed.
    """
    result = cloudpickle.loads(answer)
    if isinstance(result, TaskFailure):
        raise result.error
    return result


class _ProcessState:
    """State of a worker process: its present job."""

    job_id: ClassVar[str] = ""
    runner: ClassVar[JobRunner | None] = None


def activate_job(job_id: str, load_job: Callable[[], bytes]) -> JobRunner:
    """Return the runner of a job in the current process, created at the first call for the job.

    Args:
        job_id: Unique label of the job; the runner of another job is closed.
        load_job: Function that returns the pickled job.
    """
    if _ProcessState.runner is None or _ProcessState.job_id != job_id:
        if _ProcessState.runner is not None:
            _ProcessState.runner.close()
        _ProcessState.job_id, _ProcessState.runner = job_id, JobRunner(load_job())
    return _ProcessState.runner


def start_local_worker() -> None:
    """Prepare the current process as a worker of `LocalPool`.

    Ctrl-C is left to the main process, which ends its workers. A worker exits when the main
    process is gone, even in the middle of a task.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_with_parent, args=(os.getppid(),), daemon=True).start()


def run_local_task(job_id: str, pickled_job: bytes, pickled_task: bytes) -> bytes:
    """Run a task of a job in a process that `start_local_worker` prepared."""
    return activate_job(job_id, lambda: pickled_job).run(pickled_task)


def _exit_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_PARENT_CHECK_S)
    os._exit(1)


def make_picklable(error: Exception) -> Exception:
    """Return an error, or a `WorkerError` with its message if the error cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return WorkerError(f"{type(error).__name__}: {error}")
    return error
