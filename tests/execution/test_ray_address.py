"""Tests of addresses at which no Ray cluster answers: they are reported at once."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from handover_marl.errors import WorkerError
from handover_marl.execution import ray_pool
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import open_pool


@contextmanager
def server(greeting: bytes) -> Iterator[str]:
    """Run a server that sends some bytes to the first client, and yield the server's address."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        connections: list[socket.socket] = []

        def answer() -> None:
            connection, _ = listener.accept()
            connections.append(connection)
            connection.sendall(greeting)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        thread.join()
        for connection in connections:
            connection.close()


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_ray_that_does_not_run_is_reported_at_once(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="needs the extra `ray`")
    started = time.perf_counter()
    with pytest.raises(WorkerError, match=rf"Ray cannot be reached at {scheme}127.0.0.1:1 \(ConnectionRefusedError"):
        open_pool(PoolConfig(backend="ray", address=f"{scheme}127.0.0.1:1"))
    monkeypatch.setenv("RAY_ADDRESS", f"{scheme}127.0.0.1:1")
    with pytest.raises(WorkerError, match=f"Ray cannot be reached at {scheme}127.0.0.1:1"):
        open_pool(PoolConfig(backend="ray"))
    assert time.perf_counter() - started < 30.0


@pytest.mark.parametrize(("greeting", "error"), [(b"", TimeoutError), (b"SSH-2.0-OpenSSH_9.6\r\n", ConnectionError)])
def test_other_programs_are_not_ray(greeting: bytes, error: type[OSError], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_pool, "_CONNECTION_TIMEOUT_S", 0.2)
    with server(greeting) as address, pytest.raises(error):
        ray_pool._check_server(address)


def test_servers_of_grpc_may_be_ray() -> None:
    with server(bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])) as address:
        ray_pool._check_server(f"ray://{address}")


@pytest.mark.parametrize("address", ["", "auto", "local", "somewhere"])
def test_addresses_without_a_port_are_left_to_ray(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    connect: Callable[..., None] = lambda *_: pytest.fail("a connection was made")  # noqa: E731
    monkeypatch.setattr(socket, "create_connection", connect)
    ray_pool._check_server(address)
