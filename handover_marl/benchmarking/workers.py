"""Playing scenes in several processes.

Workers are started as programs of their own and spoken to through pipes. Unlike with multiprocessing the caller's
script is not imported again in them, so that it needs no `if __name__ == "__main__"`.
"""

import os
import select
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Generator, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType

from handover_marl.benchmarking.playing import Played, Player, Task
from handover_marl.errors import HandoverError, PolicyError, WorkerError
from handover_marl.run import Run

_ATTEMPTS = 2
_PATIENCE = 1.0


def play_tasks(run: Run, machine: str, tasks: Sequence[Task], workers: int) -> Generator[Played, None, None]:
    """Play scenes, in this process or in several, and yield each as it is finished.

    Args:
        run: What is run, resolved.
        machine: Where, in words.
        tasks: The scenes.
        workers: How many processes.

    Raises:
        WorkerError: A worker died twice over the same scene.
        HandoverError: What a worker met, as it would have come up here.
    """
    if min(workers, len(tasks)) <= 1:
        player = Player(run, machine)
        try:
            yield from map(player.play, tasks)
        finally:
            player.close()
        return
    with _Crew((run, machine), min(workers, len(tasks))) as crew:
        yield from crew.play(tasks)


class _Worker:
    """A process that plays scenes, and the pipes to it."""

    def __init__(self, job: tuple[Run, str]) -> None:
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
        self.task: Task | None = None
        self.answers = Connection(from_worker, writable=False)
        self._orders = Connection(to_worker, readable=False)
        self._send(job)

    def start(self, task: Task) -> None:
        """Give it a scene."""
        self.task = task
        self._send(task)

    def stop(self) -> None:
        """End the process."""
        self.process.terminate()
        try:
            self.process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.answers.close()
        self._orders.close()

    def _send(self, what: object) -> None:
        try:
            self._orders.send(what)
        except OSError:
            # It is dead already, which shows when its answer is waited for.
            return


class _Crew:
    """Several workers on one list of scenes."""

    def __init__(self, job: tuple[Run, str], size: int) -> None:
        self._job = job
        self._workers = [_Worker(job) for _ in range(size)]

    def __enter__(self) -> "_Crew":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for worker in self._workers:
            worker.stop()

    def play(self, tasks: Sequence[Task]) -> Iterator[Played]:
        waiting = list(reversed(tasks))
        attempts = dict.fromkeys(tasks, 0)
        while waiting or any(worker.task for worker in self._workers):
            for worker in self._workers:
                if worker.task is None and waiting:
                    attempts[waiting[-1]] += 1
                    worker.start(waiting.pop())
            busy = {worker.answers: worker for worker in self._workers if worker.task}
            for answers in wait(list(busy)):
                played = self._answer(busy[answers], waiting, attempts)  # type: ignore[index]
                if played is not None:
                    yield played

    def _answer(self, worker: _Worker, waiting: list[Task], attempts: dict[Task, int]) -> Played | None:
        """What a worker has to say; None if it died and its scene has to be played again."""
        task, worker.task = worker.task, None
        try:
            answer = worker.answers.recv()
        except (EOFError, OSError):
            self._replace(worker, task, waiting, attempts)
            return None
        if isinstance(answer, Played):
            return answer
        raise answer

    def _replace(self, worker: _Worker, task: Task | None, waiting: list[Task], attempts: dict[Task, int]) -> None:
        worker.stop()
        scene = "starting" if task is None else f"playing scene {task.scene_id}"
        if task is not None and attempts[task] < _ATTEMPTS:
            warnings.warn(
                f"a worker died while {scene} (exit status {worker.process.returncode}); it is tried once more",
                RuntimeWarning,
                stacklevel=2,
            )
            waiting.append(task)
            self._workers[self._workers.index(worker)] = _Worker(self._job)
            return
        raise WorkerError(
            f"a worker died twice while {scene} (exit status {worker.process.returncode}); finished scenes are "
            "kept. Try fewer workers if memory is short, or workers=1 to see what happens."
        )


def serve(orders: Connection, answers: Connection) -> None:
    """A worker's life: build the job, play scene after scene, until nobody gives orders any more."""
    player: Player | None = None
    run, machine = orders.recv()
    while True:
        try:
            task: Task = orders.recv()
        except EOFError:
            return
        try:
            player = player or Player(run, machine)
            answer: object = player.play(task)
        except HandoverError as error:
            answer = _portable(error)
        except Exception as error:
            # Told in words: the type of a foreign failure may not exist elsewhere.
            words = f"scene {task.scene_id}: {type(error).__name__}: {error}\n{traceback.format_exc()}"
            answer = WorkerError(words)
        try:
            answers.send(answer)
        except OSError:
            # Nobody listens any more.
            return


def _portable(error: HandoverError) -> HandoverError:
    """An error with what a policy's own code met, which would be lost on the way."""
    if isinstance(error, PolicyError):
        return PolicyError(f"{error}\n{traceback.format_exc()}")
    return error


def _watch_parent(orders: int) -> None:
    """End this process at once when the one that gives orders is gone, even in the middle of a scene.

    The pipe of orders hangs up then; a poll sees it without reading what may wait there.
    """
    hung_up = select.poll()
    hung_up.register(orders, 0)
    while True:
        if any(event & (select.POLLHUP | select.POLLERR) for _, event in hung_up.poll()):
            os._exit(0)


def main(orders: int, answers: int) -> None:
    """Serve on two open file descriptors; what a worker process runs."""
    threading.Thread(target=_watch_parent, args=(orders,), daemon=True).start()
    serve(Connection(orders, writable=False), Connection(answers, readable=False))
