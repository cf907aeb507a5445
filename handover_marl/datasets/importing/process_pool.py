"""Work on many things in processes of their own, which end when their parent does, however that ends."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import track

from handover_marl.errors import ResultsError

_Thing = TypeVar("_Thing")
_Result = TypeVar("_Result")


def worked_on(
    work: Callable[[_Thing], _Result],
    things: Sequence[_Thing],
    what: str,
    workers: int,
    progress: bool,
    prepare: Callable[..., None] | None = None,
    told: tuple[Any, ...] = (),
) -> Iterator[tuple[_Thing, _Result]]:
    """Every thing with what came of it, as they are finished.

    Args:
        work: What is done with a thing; a function of a module.
        things: What there is to do.
        what: What to call them beside the progress bar.
        workers: Processes.
        progress: Whether to show the bar on stderr.
        prepare: Called once in every process.
        told: Its arguments; small, since a process that dies before it read more than a pipe holds (64 kB) would be
            waited for for ever.

    Raises:
        ResultsError: A process died.
    """
    # Fresh processes, since forking one that has threads is not safe.
    context = multiprocessing.get_context("spawn")
    others = multiprocessing.active_children()
    count = min(workers, max(1, len(things)))
    with ProcessPoolExecutor(count, context, initializer=_start, initargs=(prepare, told)) as pool:
        try:
            pending: dict[Future[_Result], _Thing] = {pool.submit(work, thing): thing for thing in things}
            bar = track(as_completed(pending), what, len(pending), console=Console(stderr=True), disable=not progress)
            for future in bar:
                yield pending[future], future.result()
        except BrokenProcessPool as error:
            _end(others)
            raise ResultsError(
                f"a process of the import died ({error}), perhaps for lack of memory, or since the script that calls "
                'this has no `if __name__ == "__main__":`. What was written is whole; run the same again, with fewer '
                "workers"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


def _end(others: list[Any]) -> None:
    # One that was just being started when the others were ended is waited for for ever by Python 3.11's pool.
    for process in multiprocessing.active_children():
        if process not in others:
            process.kill()


def _start(prepare: Callable[..., None] | None, told: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if prepare is not None:
        prepare(*told)


def _end_with_parent() -> None:
    # A parent that was killed has told nobody, and its processes would wait for work for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
