"""Tests without a cluster: addresses at which no Ray answers, and nodes with versions that could change results."""

import time
from contextlib import nullcontext

import pytest

from handover_marl.errors import WorkerError
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import get_installed_versions, open_pool, run_ray_task
from handover_marl.execution.tasks import pickle_by_value, unpickle_result


def test_ray_that_does_not_run_is_reported_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="needs the extra `ray`")
    started = time.perf_counter()
    with pytest.raises(WorkerError, match=r"Ray cannot be reached at 127\.0\.0\.1:1 \(ConnectionRefusedError"):
        next(open_pool(PoolConfig(backend="ray", ray_address="127.0.0.1:1")).map_unordered(nullcontext, [1]))
    monkeypatch.setenv("RAY_ADDRESS", "ray://127.0.0.1:1")
    with pytest.raises(WorkerError, match=r"Ray cannot be reached at ray://127\.0\.0\.1:1"):
        next(open_pool(PoolConfig(backend="ray")).map_unordered(nullcontext, [1]))
    assert time.perf_counter() - started < 30.0


def test_nodes_must_have_the_same_versions() -> None:
    job = pickle_by_value((lambda: nullcontext(str), str)), pickle_by_value(5)
    assert unpickle_result(run_ray_task(get_installed_versions(), [], "one", *job)) == "5"
    here = get_installed_versions() | {"numpy": "0.0.1"}
    with pytest.raises(WorkerError, match=r"node .* has other versions \(numpy .* there, 0\.0\.1 here\)"):
        unpickle_result(run_ray_task(here, [], "two", *job))
