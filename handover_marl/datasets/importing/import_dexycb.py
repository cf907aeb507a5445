"""From raw DexYCB, MANO and HandoverSim's third-party archive to the data folder that HandoverSim reads."""

import multiprocessing
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import track

from handover_marl.datasets.importing.hand_assets import write_hand_assets
from handover_marl.datasets.importing.mano_model import ManoModel, read_mano_model
from handover_marl.datasets.importing.object_assets import write_object_assets
from handover_marl.datasets.importing.raw_calibration import read_betas
from handover_marl.datasets.importing.raw_layout import SequenceFolder, find_sequences
from handover_marl.datasets.importing.raw_sequence import read_meta
from handover_marl.datasets.importing.scene_import import Betas, find_first_betas, import_scene
from handover_marl.datasets.importing.stand_ins import write_stand_ins
from handover_marl.datasets.importing.table_assets import write_table_assets
from handover_marl.datasets.importing.third_party import ARCHIVE, Placed, place_third_party
from handover_marl.datasets.official_files import needed_files, stands_in
from handover_marl.errors import DataNotFoundError, HandoverError, ResultsError, SceneError
from handover_marl.options import check_workers

SIDES = ("right", "left")


@dataclass(frozen=True)
class Imported:
    """What an import did. `str(imported)` says it.

    Attributes:
        out: The data folder.
        scenes: Numbers of the scenes that are there now, ascending.
        hands: Folders of the hands that are there now.
        faults: What could not be imported, a sentence each that says where, why and what to do.
        notes: What else is worth knowing, likewise.
        lacking: Files of the third-party archive that are not there yet, relative to `assets/`.
        stand_ins: Files that stand in for those of the archive, likewise.
    """

    out: Path
    scenes: tuple[int, ...]
    hands: tuple[str, ...]
    faults: tuple[str, ...]
    notes: tuple[str, ...]
    lacking: tuple[str, ...]
    stand_ins: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether nothing is missing, nor stood in for."""
        return not (self.faults or self.lacking or self.stand_ins)

    def __str__(self) -> str:
        lines = [f"{self.out}: {len(self.scenes)} scenes, {len(self.hands)} hands."]
        lines += [f"not imported: {fault}" for fault in self.faults]
        lines += [f"note: {text}" for text in self.notes]
        if self.stand_ins:
            lines.append(
                f"{len(self.stand_ins)} files stand in for those of {ARCHIVE}, such as {self.stand_ins[0]}; results on "
                "them say so. With --third-party the original ones take their place."
            )
        if self.lacking:
            lines.append(
                f"{len(self.lacking)} files come from neither DexYCB nor MANO, such as {self.lacking[0]}: give "
                f"HandoverSim's {ARCHIVE}, or the folder that it was unpacked into, as --third-party"
            )
        lines.append(f"handover-marl doctor --data-dir {self.out} tells what is there and what it can be used for.")
        return "\n".join(lines)


def import_dexycb(
    dexycb: str | os.PathLike[str],
    mano: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    third_party: str | os.PathLike[str] | None = None,
    scenes: Iterable[int] | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Imported:
    """Write `dex-ycb-cache/` and `assets/`, to the bit as HandoverSim's scripts do.

    What is there already is compared and stays; an import that was stopped goes on where it was. A recording that is
    missing or damaged does not keep the others from being imported, under their right numbers.

    Args:
        dexycb: The folder that DexYCB's archives were expanded into.
        mano: The folder with MANO_RIGHT.pkl and MANO_LEFT.pkl, or one that has them in `models/`.
        out: The data folder to make or to go on with.
        third_party: The archive of meshes and grasps that HandoverSim's authors publish, or the folder that it was
            unpacked into. Without it, what DexYCB's `models/` allow is made: convex parts by CoACD (extra `import`),
            with the library's grasps and PyBullet's Panda.
        scenes: Only these scenes; default: all.
        workers: Processes; default: one a core.
        progress: Whether to show a progress bar on stderr.

    Raises:
        DataNotFoundError: One of the folders or of MANO's files is not there.
        UnsafeFileError, DataFormatError: One of MANO's files or the archive is not what it should be; no code in it
            is run, and nothing is written outside of the data folder.
        SceneError: There is no such scene.
        OptionError: `workers` is less than one.
        ResultsError: The data folder cannot be written, or holds models made of other data.
    """
    n_workers = check_workers(workers)
    layout = find_sequences(Path(dexycb).expanduser())
    folder = _mano_folder(Path(mano).expanduser())
    models = {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in SIDES}
    target = Path(out).expanduser()
    chosen = _chosen(layout.sequences, scenes)
    assets = target / "assets"
    notes = [*layout.ignored]
    if third_party is not None:
        notes += _third_party_notes(place_third_party(Path(third_party).expanduser(), assets))
    hands, faults = _write_models(layout.sequences, models, assets)
    done: list[int] = []
    betas = find_first_betas(layout.sequences)
    for sequence, fault in _converted(chosen, models, betas, target, n_workers, progress):
        if fault:
            faults.append(fault)
        else:
            done.append(sequence.scene_id)
    if third_party is None:
        faults += write_stand_ins(Path(dexycb).expanduser() / "models", assets, n_workers, progress)
    return Imported(
        out=target,
        scenes=tuple(sorted(done)),
        hands=tuple(hands),
        faults=(*layout.missing, *sorted(faults)),
        notes=tuple(notes),
        lacking=tuple(path for path in needed_files() if not (assets / path).is_file()),
        stand_ins=tuple(path for path in needed_files() if stands_in(assets / path)),
    )


def _third_party_notes(placed: Placed) -> list[str]:
    if not placed.different:
        return []
    return [
        f"{len(placed.different)} of the {len(placed.files)} third-party files are not the known ones, such as "
        f"{placed.different[0]}; results on them say so"
    ]


def _mano_folder(mano: Path) -> Path:
    for folder in (mano, mano / "models"):
        if (folder / "MANO_RIGHT.pkl").is_file():
            return folder
    raise DataNotFoundError(
        f"{mano} holds no MANO_RIGHT.pkl, nor does its models/. Register at MANO's site, download mano_v1_2.zip and "
        "give the folder that it was expanded into."
    )


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
    # A person's hands are made from the first recording's shape, whichever hand that shows.
    for sequence in sequences:
        if sequence.scene_id % 100:
            continue
        try:
            betas = read_betas(sequence.calibration, read_meta(sequence).mano_calib)
            hands += [write_hand_assets(assets, sequence.subject, models[side], betas).name for side in SIDES]
        except ResultsError:
            raise
        except HandoverError as error:
            faults.append(f"hands of {sequence.subject}: {error}")
    return hands, faults


def _converted(
    sequences: Sequence[SequenceFolder],
    models: dict[str, ManoModel],
    betas: Betas,
    out: Path,
    workers: int,
    progress: bool,
) -> Iterator[tuple[SequenceFolder, str]]:
    """Every recording with what kept it from being imported, empty if nothing did, as they are finished."""
    # Fresh processes, since forking one that has threads is not safe.
    context = multiprocessing.get_context("spawn")
    count = min(workers, max(1, len(sequences)))
    with ProcessPoolExecutor(count, context, initializer=_start, initargs=(models, betas, out)) as pool:
        pending: dict[Future[str], SequenceFolder] = {pool.submit(_import_one, one): one for one in sequences}
        try:
            bar = track(
                as_completed(pending), "scenes", len(pending), console=Console(stderr=True), disable=not progress
            )
            for future in bar:
                yield pending[future], future.result()
        except BrokenProcessPool as error:
            raise ResultsError(
                f"a process of the import died ({error}), perhaps for lack of memory. What is in {out} is whole; run "
                "the same again, with fewer workers"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)


_given: tuple[dict[str, ManoModel], Betas, Path]


def _start(models: dict[str, ManoModel], betas: Betas, out: Path) -> None:
    """What a process is told once."""
    global _given
    _given = models, betas, out


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
