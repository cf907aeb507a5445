"""Tasks done by the workers of a pool: who does which, and what happens when one is gone."""

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any

from handover_marl.errors import WorkerError
from handover_marl.pools.pool import Failed, Job, Pool, Ready, Worker, WorkerGoneError

#: So many workers may die over a task.
ATTEMPTS = 2
#: So often a task may lose its worker with the machine that it was on, which says nothing about the task.
LOSSES = 5


class Crew:
    """Workers of one job.

    Args:
        pool: Where they come from.
        job: What they do.
        tasks: The tasks; there are no more workers than these.
    """

    def __init__(self, pool: Pool, job: Job[Any, Any], tasks: Sequence[Any]) -> None:
        self._pool, self._job, self._tasks = pool, job, tasks
        self._waiting = list(reversed(range(len(tasks))))
        self._gone: dict[bool, Counter[int | None]] = {True: Counter(), False: Counter()}
        self._order = pool.order(job)
        self._workers: list[Worker] = []

    def __enter__(self) -> "Crew":
        self._workers = [self._pool.hire(self._order) for _ in range(min(self._pool.size, len(self._tasks)))]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.dismiss()
        for worker in self._workers:
            worker.end()

    def answers(self) -> Iterator[tuple[int, Any]]:
        """Numbers of tasks and what came of them, as they are finished.

        Raises:
            WorkerError: A worker died twice over the same task.
            HandoverError: What a worker met.
        """
        while self._waiting or any(worker.task is not None for worker in self._workers):
            for worker in self._workers:
                if worker.ready and worker.task is None and self._waiting:
                    worker.task = self._waiting.pop()
                    worker.give(self._tasks[worker.task])
            for worker in self._pool.wait([one for one in self._workers if one.task is not None or not one.ready]):
                yield from self._heard(worker)

    def _heard(self, worker: Worker) -> Iterator[tuple[int, Any]]:
        try:
            said = worker.heard()
        except WorkerGoneError as gone:
            self._replace(worker, gone)
            return
        number, worker.task = worker.task, None
        if isinstance(said, Failed):
            raise said.error
        if isinstance(said, Ready):
            worker.ready = True
            for times in self._gone.values():
                del times[None]  # workers can be started again
        elif number is not None:
            yield number, said

    def _replace(self, worker: Worker, gone: WorkerGoneError) -> None:
        """Another worker for one that is gone, and its task back to those that are to be done."""
        number = worker.task
        words = "starting" if number is None else self._job.words(self._tasks[number])
        times = self._gone[gone.by_itself]
        times[number] += 1
        if times[number] >= (ATTEMPTS if gone.by_itself else LOSSES):
            often = "twice" if gone.by_itself else f"{LOSSES} times with its machine"
            raise WorkerError(
                f"a worker died {often} while {words} ({gone}); what was finished is kept. Try fewer workers if memory "
                "is short, or workers=1 to see what happens."
            )
        warnings.warn(f"a worker died while {words} ({gone}); it is tried once more", RuntimeWarning, stacklevel=2)
        worker.dismiss()
        worker.end()
        if number is not None:
            self._waiting.append(number)
        self._workers[self._workers.index(worker)] = self._pool.hire(self._order)
