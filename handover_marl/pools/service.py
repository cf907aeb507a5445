"""A worker's side: doing tasks, and telling why one could not be done."""

import traceback
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import cloudpickle

from handover_marl.errors import HandoverError, PolicyError, WorkerError
from handover_marl.pools.pool import Failed, Job


class Service:
    """Does the tasks of a job, one after another.

    Args:
        job: The job, pickled; it is unpacked at the first task, so that what it meets there is told like all else.
    """

    def __init__(self, job: bytes) -> None:
        self._pickled = job
        self._job: Job[Any, Any] | None = None
        self._work: Callable[[Any], Any] | None = None
        self._open = ExitStack()

    def answer(self, task: bytes) -> bytes:
        """What came of a task, or `Failed`, pickled."""
        try:
            answer: bytes = cloudpickle.dumps(self._done(task))
        except Exception as error:  # what pickling meets has no end
            told = f"an answer cannot be sent ({type(error).__name__}: {error})"
            answer = cloudpickle.dumps(Failed(WorkerError(told)))
        return answer

    def _done(self, task: bytes) -> object:
        words = "a task"
        try:
            self._job = self._job or cloudpickle.loads(self._pickled)
            given = cloudpickle.loads(task)
            words = self._job.words(given)
            self._work = self._work or self._open.enter_context(self._job.prepare())
            return self._work(given)
        except HandoverError as error:
            return Failed(_portable(error))
        except Exception as error:
            # Told in words: the type of a foreign failure may not exist elsewhere.
            told = f"{words}: {type(error).__name__}: {error}\n{traceback.format_exc()}"
            return Failed(WorkerError(told))

    def close(self) -> None:
        """Free what the work holds."""
        self._open.close()


def _portable(error: HandoverError) -> HandoverError:
    """An error with what a policy's own code met, which would be lost on the way."""
    if isinstance(error, PolicyError):
        return PolicyError(f"{error}\n{traceback.format_exc()}")
    return error
