"""Workers on this machine.

They are started as programs of their own and spoken to through pipes. Unlike with multiprocessing the caller's script
is not imported again in them, so that it needs no `if __name__ == "__main__"`.
"""

import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

import cloudpickle

from handover_marl.pools.pool import Job, Pool, Worker, WorkerGoneError
from handover_marl.pools.service import Service

_PATIENCE = 1.0


class LocalPool(Pool):
    """Processes of this machine.

    Args:
        size: How many.
    """

    def __init__(self, size: int) -> None:
        self.size = size

    def order(self, job: Job[Any, Any]) -> bytes:
        """As `Pool.order`."""
        order: bytes = cloudpickle.dumps(job)
        return order

    def hire(self, order: bytes) -> "LocalWorker":
        """As `Pool.hire`."""
        return LocalWorker(order)

    def wait(self, workers: Sequence[Worker]) -> list[Worker]:
        """As `Pool.wait`."""
        by_pipe = {worker.answers: worker for worker in workers if isinstance(worker, LocalWorker)}
        return [by_pipe[answers] for answers in wait(list(by_pipe))]  # type: ignore[index]


class LocalWorker(Worker):
    """A process, and the pipes to it."""

    def __init__(self, order: bytes) -> None:
        from_parent, to_worker = os.pipe()
        from_worker, to_parent = os.pipe()
        # The caller's own search path, so that the worker finds what the caller finds and nothing else.
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main(*map(int, sys.argv[1:]))"
        command = [sys.executable, "-c", code, str(from_parent), str(to_parent)]
        self.process = subprocess.Popen(
            # A session of its own, because Ctrl-C is for the parent, which ends its workers itself.
            command,
            pass_fds=(from_parent, to_parent),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(from_parent)
        os.close(to_parent)
        self.answers = Connection(from_worker, writable=False)
        self._orders = Connection(to_worker, readable=False)
        self._send(order)

    def give(self, task: Any) -> None:
        """As `Worker.give`."""
        self._send(cloudpickle.dumps(task))

    def heard(self) -> object:
        """As `Worker.heard`."""
        try:
            return cloudpickle.loads(self.answers.recv_bytes())
        except (EOFError, OSError) as error:
            self.dismiss()
            self.end()
            raise WorkerGoneError(f"exit status {self.process.returncode}", by_itself=True) from error

    def dismiss(self) -> None:
        """As `Worker.dismiss`."""
        self.process.terminate()

    def end(self) -> None:
        """As `Worker.end`."""
        try:
            self.process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.answers.close()
        self._orders.close()

    def _send(self, what: bytes) -> None:
        try:
            self._orders.send_bytes(what)
        except OSError:
            # It is dead already, which shows when its answer is waited for.
            return


def serve(orders: Connection, answers: Connection, ending: threading.Event) -> None:
    """A worker's life: task after task, until nobody gives orders any more, or it is to end."""
    service = Service(orders.recv_bytes())
    try:
        while not ending.is_set():
            answers.send_bytes(service.answer(orders.recv_bytes()))
    except (EOFError, OSError):
        # Nobody asks or listens any more.
        return
    finally:
        service.close()


def _watch_parent(orders: int) -> None:
    """End this process at once when the one that gives orders is gone, even in the middle of a task.

    The pipe of orders hangs up then; a poll sees it without reading what may wait there.
    """
    hung_up = select.poll()
    hung_up.register(orders, 0)
    while True:
        if any(event & (select.POLLHUP | select.POLLERR) for _, event in hung_up.poll()):
            os._exit(0)


def main(orders: int, answers: int) -> None:
    """Serve on two open file descriptors; what a worker process runs."""
    ending = threading.Event()

    def end(*_: object) -> None:
        # By an exception, so that whoever writes a file leaves no half of it; a policy's caller may take it for its.
        ending.set()
        sys.exit(1)

    signal.signal(signal.SIGTERM, end)
    threading.Thread(target=_watch_parent, args=(orders,), daemon=True).start()
    serve(Connection(orders, writable=False), Connection(answers, readable=False), ending)
