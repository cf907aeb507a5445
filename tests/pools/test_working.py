"""Work in this process, in others of this machine, and what is refused."""

import os
import signal
import threading
from contextlib import contextmanager
from typing import Any

import pytest

from handover_marl.errors import OptionError, ResultsError, UnknownNameError, WorkerError
from handover_marl.pools import pool_config
from handover_marl.pools.pool import Job
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import answers, open_pool, worked_on


def job(notes: list[str] | None = None) -> Job[int, Any]:
    """Tells the process and ten times the task."""

    @contextmanager
    def prepare() -> Any:
        (notes if notes is not None else []).append("prepared")
        yield lambda task: (os.getpid(), 10 * task)
        (notes if notes is not None else []).append("closed")

    return Job(prepare, str)


def test_one_worker_is_this_process() -> None:
    notes: list[str] = []
    found = list(answers(open_pool(PoolConfig(1)), job(notes), [1, 2, 3]))
    assert found == [(number, (os.getpid(), 10 * number + 10)) for number in range(3)]
    assert notes == ["prepared", "closed"]
    assert list(answers(open_pool(PoolConfig(2)), job(notes), [])) == []
    assert len(notes) == 2


def test_several_are_others_and_do_what_is_written_here() -> None:
    """Functions within functions, which no other process could import."""
    found = sorted(answers(open_pool(PoolConfig(2)), job(), [1, 2, 3, 4]))
    assert [answer for _, (_, answer) in found] == [10, 20, 30, 40]
    processes = {process for _, (process, _) in found}
    assert 1 <= len(processes) <= 2
    assert os.getpid() not in processes


def test_things_with_what_came_of_them() -> None:
    done = dict(worked_on(lambda: lambda name: name.upper(), ["a", "b", "c"], "names", PoolConfig(2), progress=False))
    assert done == {"a": "A", "b": "B", "c": "C"}


def fails(kind: type[Exception]) -> Any:
    def work(task: int) -> None:
        raise kind("nonsense")

    return lambda: work


def test_failures_come_up() -> None:
    with pytest.raises(ResultsError, match=r"^nonsense$"):
        dict(worked_on(fails(ResultsError), [1, 2], "numbers", PoolConfig(2), progress=False))
    with pytest.raises(WorkerError, match=r"(?s)^numbers: [12]: KeyError: 'nonsense'.*in work"):
        dict(worked_on(fails(KeyError), [1, 2], "numbers", PoolConfig(2), progress=False))
    with pytest.raises(KeyError):
        dict(worked_on(fails(KeyError), [1, 2], "numbers", PoolConfig(1), progress=False))


def test_answers_that_cannot_be_sent() -> None:
    with pytest.raises(WorkerError, match=r"an answer cannot be sent .*lock"):
        dict(worked_on(lambda: lambda _: threading.Lock(), [1, 2], "locks", PoolConfig(2), progress=False))


@pytest.mark.filterwarnings("ignore:a worker died")
def test_a_thing_that_kills_its_worker_twice() -> None:
    def work(task: int) -> int:
        if task == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return task

    with pytest.raises(WorkerError, match=r"died twice while numbers: 2 \(exit status -9\)"):
        dict(worked_on(lambda: work, [1, 2, 3], "numbers", PoolConfig(2), progress=False))


def test_pools_that_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownNameError, match="unknown backend 'slurm'; valid: local, ray"):
        open_pool(PoolConfig(backend="slurm"))
    with pytest.raises(OptionError, match="workers=0"):
        open_pool(PoolConfig(0))
    with pytest.raises(OptionError, match="ray_address is 'here:1', but the backend is 'local'"):
        open_pool(PoolConfig(address="here:1"))
    monkeypatch.setattr(pool_config.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"needs Ray: pip install 'handover-marl\[ray\]'"):
        open_pool(PoolConfig(backend="ray"))
