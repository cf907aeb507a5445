"""Tests of tasks in this process and in worker processes of this machine, and of Ray without a cluster."""

import os
import signal
import time
from collections.abc import Callable
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

from handover_marl.errors import OptionError, ResultsError, WorkerError
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import Pool, get_installed_versions, map_with_progress, open_pool, run_ray_task
from handover_marl.execution.tasks import pickle_by_value, unpickle_result

ROOT = Path(__file__).resolve().parents[2]


def run(function: Callable[[Any], Any], tasks: list[Any], workers: int = 2) -> dict[Any, Any]:
    return dict(map_with_progress(lambda: function, tasks, "numbers", PoolConfig(workers), progress=False))


def open_worker(events: list[str]) -> Callable[[], Any]:
    @contextmanager
    def prepare() -> Any:
        events.append("opened")
        yield lambda task: (os.getpid(), 10 * task)
        events.append("closed")

    return prepare


def test_one_worker_is_this_process() -> None:
    events: list[str] = []
    found = list(open_pool(PoolConfig(1)).map_unordered(open_worker(events), [1, 2, 3]))
    assert found == [(index, (os.getpid(), 10 * index + 10)) for index in range(3)]
    assert events == ["opened", "closed"]
    assert list(open_pool(PoolConfig(2)).map_unordered(open_worker(events), [])) == []
    assert len(events) == 2


@pytest.mark.slow
def test_errors_of_tasks_are_raised_here() -> None:
    def work(kind: type[Exception]) -> None:
        raise kind("nonsense")

    with pytest.raises(ResultsError, match=r"^nonsense$"):
        run(work, [ResultsError] * 2)
    with pytest.raises(WorkerError, match=r"(?s)^numbers: .*: KeyError: 'nonsense'.*in work"):
        run(work, [KeyError] * 2)
    with pytest.raises(KeyError):
        run(work, [KeyError] * 2, workers=1)


def kill_this_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_killed_worker_is_reported_and_replaced() -> None:
    def work(task: int) -> int:
        if task == 2:
            kill_this_process()
        return task

    with closing(Pool(2)) as pool:
        with pytest.raises(
            WorkerError, match=r"died while .*2.* \(exit code .*-9\).*; results in an output folder are kept"
        ):
            list(pool.map_unordered(lambda: nullcontext(work), [1, 2, 3]))
        assert sorted(pool.map_unordered(lambda: nullcontext(work), [3, 4])) == [(0, 3), (1, 4)]


@pytest.mark.slow
def test_closing_ends_running_tasks() -> None:
    def work(task: int) -> int:
        time.sleep(60.0 * task)
        return os.getpid()

    results = open_pool(PoolConfig(2)).map_unordered(lambda: nullcontext(work), [0, 1, 1])
    started = time.monotonic()
    _, process = next(results)
    results.close()
    assert time.monotonic() - started < 20.0
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_invalid_configurations(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match=r"workers must be .* got 0"):
        open_pool(PoolConfig(0))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"needs ray: pip install 'handover-marl\[ray\]'"):
        open_pool(PoolConfig(ray_address="auto"))


@pytest.mark.slow
def test_a_pool_keeps_its_processes() -> None:
    """Processes run functions that are defined within functions, and are kept for the next job."""

    def run_shared(function: Callable[[int], object]) -> list[object]:
        found = pool.map_unordered(lambda: nullcontext(function), [0, 1, 2, 3])
        return [result for _, result in sorted(found)]

    def get_process(task: int) -> int:
        time.sleep(0.2)
        return os.getpid()

    with closing(Pool(2)) as pool:
        first = set(run_shared(get_process))
        assert len(first - {os.getpid()}) == 2
        assert run_shared(lambda task: task + 1) == [1, 2, 3, 4]
        assert set(run_shared(get_process)) == first
    for process in first:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def test_ray_that_does_not_run_is_reported_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="needs the extra `ray`")
    started = time.perf_counter()
    with pytest.raises(WorkerError, match=r"Ray cannot be reached at 127\.0\.0\.1:1 \(ConnectionRefusedError"):
        next(open_pool(PoolConfig(ray_address="127.0.0.1:1")).map_unordered(nullcontext, [1]))
    monkeypatch.setenv("RAY_ADDRESS", "ray://127.0.0.1:1")
    with pytest.raises(WorkerError, match=r"Ray cannot be reached at ray://127\.0\.0\.1:1"):
        next(open_pool(PoolConfig(ray_address="auto")).map_unordered(nullcontext, [1]))
    assert time.perf_counter() - started < 30.0


def test_nodes_must_have_the_same_versions() -> None:
    job = pickle_by_value((lambda: nullcontext(str), str)), pickle_by_value(5)
    assert unpickle_result(run_ray_task(get_installed_versions(), [], "one", *job)) == "5"
    here = get_installed_versions() | {"numpy": "0.0.1"}
    with pytest.raises(WorkerError, match=r"node .* has other versions \(numpy .* there, 0\.0\.1 here\)"):
        unpickle_result(run_ray_task(here, [], "two", *job))
