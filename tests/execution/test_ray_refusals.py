"""Tests without a cluster: addresses at which no Ray answers, and nodes with versions that could change results."""

import socket
import time
from collections.abc import Callable
from contextlib import nullcontext

import pytest

from handover_marl.errors import WorkerError
from handover_marl.execution import pool as ray_pool
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import check_versions, get_installed_versions, open_pool


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_ray_that_does_not_run_is_reported_at_once(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="needs the extra `ray`")
    started = time.perf_counter()
    with pytest.raises(WorkerError, match=rf"Ray cannot be reached at {scheme}127.0.0.1:1 \(ConnectionRefusedError"):
        next(open_pool(PoolConfig(backend="ray", ray_address=f"{scheme}127.0.0.1:1")).map_unordered(nullcontext, [1]))
    monkeypatch.setenv("RAY_ADDRESS", f"{scheme}127.0.0.1:1")
    with pytest.raises(WorkerError, match=f"Ray cannot be reached at {scheme}127.0.0.1:1"):
        next(open_pool(PoolConfig(backend="ray")).map_unordered(nullcontext, [1]))
    assert time.perf_counter() - started < 30.0


@pytest.mark.parametrize("address", ["", "auto", "local", "somewhere"])
def test_addresses_without_a_port_are_left_to_ray(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    connect: Callable[..., None] = lambda *_: pytest.fail("a connection was made")  # noqa: E731
    monkeypatch.setattr(socket, "create_connection", connect)
    ray_pool._check_server(address)


def test_equal_versions() -> None:
    check_versions(get_installed_versions(), get_installed_versions())


@pytest.mark.parametrize("name", ["handover_marl", "numpy", "scipy", "pybullet"])
@pytest.mark.parametrize("there", ["0.0.1", "none"])
def test_other_versions(name: str, there: str) -> None:
    with pytest.raises(WorkerError, match=f"node .* has other versions \\({name} {there} there, .* here\\)"):
        check_versions(get_installed_versions(), {**get_installed_versions(), name: there})


def test_mujoco_may_be_missing_but_not_differ() -> None:
    check_versions(get_installed_versions(), {**get_installed_versions(), "mujoco": "none"})
    if get_installed_versions()["mujoco"] == "none":
        pytest.skip("needs MuJoCo")
    with pytest.raises(WorkerError, match=r"mujoco 3\.9\.0 there"):
        check_versions(get_installed_versions(), {**get_installed_versions(), "mujoco": "3.9.0"})
