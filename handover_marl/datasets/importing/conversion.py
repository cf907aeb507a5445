"""Many recordings to scenes, in processes of their own."""

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from rich.console import Console
from rich.progress import track

from handover_marl.datasets.importing.mano_model import SIDES, ManoModel, read_mano_model
from handover_marl.datasets.importing.raw_layout import SequenceFolder
from handover_marl.datasets.importing.scene_import import Betas, import_scene
from handover_marl.errors import HandoverError, ResultsError


def read_models(folder: Path) -> dict[str, ManoModel]:
    """MANO's hands by side.

    Raises:
        DataNotFoundError, UnsafeFileError, DataFormatError: As `read_mano_model`.
    """
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in SIDES}


def converted(
    sequences: Sequence[SequenceFolder],
    mano: Path,
    betas: Betas,
    out: Path,
    workers: int,
    progress: bool,
) -> Iterator[tuple[SequenceFolder, str]]:
    """Every recording with what kept it from being imported, empty if nothing did, as they are finished."""
    # Fresh processes, since forking one that has threads is not safe.
    context = multiprocessing.get_context("spawn")
    count = min(workers, max(1, len(sequences)))
    with ProcessPoolExecutor(count, context, initializer=_start, initargs=(mano, betas, out)) as pool:
        try:
            pending: dict[Future[str], SequenceFolder] = {pool.submit(_import_one, one): one for one in sequences}
            bar = track(
                as_completed(pending), "scenes", len(pending), console=Console(stderr=True), disable=not progress
            )
            for future in bar:
                yield pending[future], future.result()
        except BrokenProcessPool as error:
            raise ResultsError(
                f"a process of the import died ({error}), perhaps for lack of memory, or since the script that calls "
                f'this has no `if __name__ == "__main__":`. What is in {out} is whole; run the same again, with fewer '
                "workers"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


_given: tuple[dict[str, ManoModel], Betas, Path]


def _start(mano: Path, betas: Betas, out: Path) -> None:
    """What a process is told once.

    The models are not sent: with more than a pipe holds (64 kB), the parent would wait for ever for a process that
    died before it read them.
    """
    global _given
    _given = read_models(mano), betas, out
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # A parent that was killed has told nobody, and its processes would wait for work for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _import_one(sequence: SequenceFolder) -> str:
    models, betas, out = _given
    try:
        import_scene(sequence, models, betas, out)
    except ResultsError:
        # The data folder's fault, not the recording's: no other scene would do better.
        raise
    except HandoverError as error:
        return f"scene {sequence.scene_id:03d} ({sequence.name}): {error}"
    return ""
