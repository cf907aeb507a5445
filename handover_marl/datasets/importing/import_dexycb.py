"""From raw DexYCB and MANO to the data folder that HandoverSim reads, as far as these two tell it."""

import multiprocessing
import os
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.progress import track

from handover_marl.datasets.importing.cache_writer import CACHE_FOLDER
from handover_marl.datasets.importing.hand_assets import write_hand_assets
from handover_marl.datasets.importing.hand_sides import check_sides
from handover_marl.datasets.importing.mano_model import ManoModel, read_mano_model
from handover_marl.datasets.importing.object_assets import write_object_assets
from handover_marl.datasets.importing.raw_layout import SequenceFolder, find_sequences
from handover_marl.datasets.importing.scene_import import Betas, find_first_betas, import_scene, read_hand_betas
from handover_marl.datasets.importing.table_assets import write_table_assets
from handover_marl.datasets.official import PANDA_FILES, WITHOUT_GRASPS
from handover_marl.errors import DataNotFoundError, HandoverError, ResultsError, SceneError
from handover_marl.files import remove_abandoned
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.options import check_workers

SIDES = ("right", "left")
#: What neither DexYCB nor MANO has: it comes in an archive of HandoverSim's authors, relative to `assets/`.
THIRD_PARTY = (
    *(
        f"{name}/{mesh}"
        for name in CLASS_NAMES.values()
        for mesh in ("textured_simple.obj", "model_normalized_convex.obj")
    ),
    *PANDA_FILES.values(),
    *(f"grasps/{name}.npy" for name in CLASS_NAMES.values() if name not in WITHOUT_GRASPS),
)


@dataclass(frozen=True)
class Imported:
    """What an import did. `str(imported)` says it.

    Attributes:
        out: The data folder.
        scenes: Numbers of the scenes that are there now, ascending.
        hands: Folders of the hands that are there now.
        faults: What could not be imported, a sentence each that says where, why and what to do.
        ignored: What was passed over, likewise.
        lacking: Files of the third-party archive that are not there yet, relative to `assets/`.
    """

    out: Path
    scenes: tuple[int, ...]
    hands: tuple[str, ...]
    faults: tuple[str, ...]
    ignored: tuple[str, ...]
    lacking: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return not (self.faults or self.lacking)

    def __str__(self) -> str:
        lines = [f"{self.out}: {len(self.scenes)} scenes, {len(self.hands)} hands."]
        lines += [f"not imported: {fault}" for fault in self.faults]
        lines += [f"note: {text}" for text in self.ignored]
        if self.lacking:
            lines.append(
                f"{len(self.lacking)} files come from neither DexYCB nor MANO, such as {self.lacking[0]}: expand "
                f"HandoverSim's assets-3rd-party archive into {self.out / 'assets'}"
            )
        return "\n".join(lines)


def import_dexycb(
    dexycb: str | os.PathLike[str],
    mano: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scenes: Iterable[int] | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Imported:
    """Write `dex-ycb-cache/` and the models of hands, objects and table, to the bit as HandoverSim's scripts do.

    What is there already is compared and stays; an import that was stopped goes on where it was. A recording that is
    missing or damaged does not keep the others from being imported, under their right numbers.

    Args:
        dexycb: The folder that DexYCB's archives were expanded into.
        mano: The folder with MANO_RIGHT.pkl and MANO_LEFT.pkl, or one that has them in `models/`.
        out: The data folder to make or to go on with.
        scenes: Only these scenes; default: all.
        workers: Processes; default: one a core.
        progress: Whether to show a progress bar on stderr.

    Raises:
        DataNotFoundError: One of the folders or of MANO's files is not there.
        UnsafeFileError, DataFormatError: One of MANO's files is not what it should be; no code in it is run.
        SceneError: There is no such scene.
        OptionError: `workers` is less than one.
        ResultsError: The data folder cannot be written, or holds models made of other data.
    """
    n_workers = check_workers(workers)
    layout = find_sequences(Path(dexycb).expanduser())
    folder = _mano_folder(Path(mano).expanduser())
    models = _read_models(folder)
    check_sides(models["right"], models["left"], folder)
    target = Path(out).expanduser()
    chosen = _chosen(layout.sequences, scenes)
    hands, faults = _write_models(layout.sequences, models, target / "assets")
    remove_abandoned(target / CACHE_FOLDER)
    done: list[int] = []
    betas = find_first_betas(layout.sequences)
    for sequence, fault in _converted(chosen, folder, betas, target, n_workers, progress):
        if fault:
            faults.append(fault)
        else:
            done.append(sequence.scene_id)
    return Imported(
        out=target,
        scenes=tuple(sorted(done)),
        hands=tuple(hands),
        faults=(*layout.missing, *sorted(faults)),
        ignored=layout.ignored,
        lacking=tuple(name for name in THIRD_PARTY if not (target / "assets" / name).is_file()),
    )


def _mano_folder(mano: Path) -> Path:
    for folder in (mano, mano / "models"):
        if (folder / "MANO_RIGHT.pkl").is_file():
            return folder
    raise DataNotFoundError(
        f"{mano} holds no MANO_RIGHT.pkl, nor does its models/. Register at MANO's site, download mano_v1_2.zip and "
        "give the folder that it was expanded into."
    )


def _read_models(folder: Path) -> dict[str, ManoModel]:
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in SIDES}


def _chosen(sequences: Sequence[SequenceFolder], scenes: Iterable[int] | None) -> list[SequenceFolder]:
    if scenes is None:
        return list(sequences)
    wanted = set(scenes)
    foreign = sorted(wanted - set(range(1000)), key=str)
    if foreign:
        raise SceneError(f"scene {foreign[0]} does not exist; scenes are numbered 0 to 999")
    return [sequence for sequence in sequences if sequence.scene_id in wanted]


def _write_models(
    sequences: Sequence[SequenceFolder], models: dict[str, ManoModel], assets: Path
) -> tuple[list[str], list[str]]:
    """Write all models; names of the hands' folders, and what could not be made."""
    write_object_assets(assets)
    write_table_assets(assets)
    hands, faults = [], []
    for subject, recordings in groupby(sequences, lambda sequence: sequence.subject):
        try:
            betas = read_hand_betas(list(recordings))
            hands += [write_hand_assets(assets, subject, models[side], betas).name for side in SIDES]
        except ResultsError:
            raise
        except HandoverError as error:
            faults.append(f"hands of {subject}: {error}")
    return hands, faults


def _converted(
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
    _given = _read_models(mano), betas, out
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
