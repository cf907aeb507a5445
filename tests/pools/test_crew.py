"""Who does which task and what happens when a worker is gone, with workers that are made up."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any

import pytest

from handover_marl.errors import OptionError, WorkerError
from handover_marl.pools.crew import LOSSES, Crew
from handover_marl.pools.pool import Failed, Job, Pool, Ready, Worker, WorkerGoneError

JOB: Job[int, int] = Job(lambda: nullcontext(lambda task: 10 * task), lambda task: f"doing {task}")


class MadeUpWorker(Worker):
    """Says what the pool decides."""

    def __init__(self, pool: "MadeUpPool", starts: bool) -> None:
        self.pool, self.ready, self.given, self.ended = pool, not starts, -1, False

    def give(self, task: int) -> None:
        assert self.ready
        self.given = task
        self.pool.given.append(task)

    def heard(self) -> object:
        assert not self.ended
        if not self.ready:
            return self.pool.starting()
        said = self.pool.says(self.given)
        if isinstance(said, Exception):
            raise said
        return said

    def dismiss(self) -> None:
        self.ended = True


class MadeUpPool(Pool):
    """Workers that speak in turn, the last one first."""

    def __init__(self, size: int, says: Callable[[int], object], starting: Callable[[], object] | None = None) -> None:
        self.size, self.says, self.starting = size, says, starting or Ready
        self._starts = starting is not None
        self.given: list[int] = []
        self.hired: list[MadeUpWorker] = []

    def order(self, job: Any) -> Any:
        return job

    def hire(self, order: Any) -> Worker:
        self.hired.append(MadeUpWorker(self, self._starts))
        return self.hired[-1]

    def wait(self, workers: Sequence[Worker]) -> list[Worker]:
        assert workers, "nobody is waited for"
        return [workers[-1]]


def done(pool: MadeUpPool, tasks: Sequence[int]) -> list[tuple[int, Any]]:
    with Crew(pool, JOB, tasks) as crew:
        found = sorted(crew.answers())
    assert all(worker.ended for worker in pool.hired)
    return found


def dying(often: int, by_itself: bool, task: int = 2) -> Callable[[int], object]:
    """A task that takes so many workers with it."""
    left = [often]

    def says(given: int) -> object:
        if given == task and left[0]:
            left[0] -= 1
            return WorkerGoneError("gone", by_itself)
        return 10 * given

    return says


def test_every_task_is_done_once_in_their_order() -> None:
    pool = MadeUpPool(2, lambda task: 10 * task)
    assert done(pool, [1, 2, 3, 4]) == [(0, 10), (1, 20), (2, 30), (3, 40)]
    assert pool.given == [1, 2, 3, 4]
    assert len(pool.hired) == 2


def test_no_more_workers_than_tasks() -> None:
    pool = MadeUpPool(8, lambda task: task)
    assert len(done(pool, [1, 2])) == len(pool.hired) == 2


def test_workers_that_start_later_are_not_waited_for() -> None:
    """As where a cluster has fewer cores than workers are wanted."""

    class OneCore(MadeUpPool):
        def wait(self, workers: Sequence[Worker]) -> list[Worker]:
            return [worker for worker in workers if worker is self.hired[0]]

    pool = OneCore(3, lambda task: task, starting=Ready)
    assert done(pool, [1, 2, 3]) == [(0, 1), (1, 2), (2, 3)]
    assert [worker.given for worker in pool.hired] == [3, -1, -1]


def test_a_task_that_lost_its_worker_is_tried_again_at_once() -> None:
    pool = MadeUpPool(2, dying(1, by_itself=True))
    with pytest.warns(RuntimeWarning, match=r"a worker died while doing 2 \(gone\); it is tried once more"):
        assert done(pool, [1, 2, 3, 4]) == [(0, 10), (1, 20), (2, 30), (3, 40)]
    assert sorted(pool.given) == [1, 2, 2, 3, 4]
    assert pool.given.index(2, 2) == 2, "before those that were never tried"
    assert len(pool.hired) == 3


@pytest.mark.filterwarnings("ignore:a worker died")
def test_a_task_that_kills_two_workers_ends_all() -> None:
    pool = MadeUpPool(2, dying(2, by_itself=True))
    with pytest.raises(WorkerError, match=r"died twice while doing 2 \(gone\); what was finished is kept"):
        done(pool, [1, 2, 3])
    assert pool.given.count(2) == 2
    assert all(worker.ended for worker in pool.hired)


@pytest.mark.filterwarnings("ignore:a worker died")
def test_machines_that_go_are_not_the_tasks_fault() -> None:
    assert len(done(MadeUpPool(2, dying(LOSSES - 1, by_itself=False)), [1, 2, 3])) == 3
    with pytest.raises(WorkerError, match=f"died {LOSSES} times with its machine while doing 2"):
        done(MadeUpPool(2, dying(LOSSES, by_itself=False)), [1, 2, 3])


@pytest.mark.filterwarnings("ignore:a worker died")
def test_workers_that_never_start() -> None:
    def starting() -> object:
        raise WorkerGoneError("no core", by_itself=True)

    with pytest.raises(WorkerError, match=r"died twice while starting \(no core\)"):
        done(MadeUpPool(2, lambda task: task, starting), [1, 2])


def test_errors_come_up() -> None:
    pool = MadeUpPool(2, lambda task: Failed(OptionError(f"not {task}")))
    with pytest.raises(OptionError, match="not 2"):
        done(pool, [1, 2, 3])
    assert all(worker.ended for worker in pool.hired)
