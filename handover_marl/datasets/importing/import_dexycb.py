"""From raw DexYCB, MANO and HandoverSim's third-party archive to the data folder that HandoverSim reads."""

import os
from collections.abc import Iterable, Sequence
from contextlib import closing
from itertools import groupby
from pathlib import Path

from handover_marl.datasets.importing.cache_writer import CACHE_FOLDER
from handover_marl.datasets.importing.conversion import converted, read_models
from handover_marl.datasets.importing.hand_assets import write_hand_assets
from handover_marl.datasets.importing.hand_sides import doubts_about_sides
from handover_marl.datasets.importing.imported import Imported
from handover_marl.datasets.importing.mano_model import SIDES, ManoModel
from handover_marl.datasets.importing.object_assets import write_object_assets
from handover_marl.datasets.importing.raw_layout import SequenceFolder, find_sequences
from handover_marl.datasets.importing.scene_import import find_first_betas, read_hand_betas
from handover_marl.datasets.importing.stand_ins import write_stand_ins
from handover_marl.datasets.importing.table_assets import table_folder, write_table_assets
from handover_marl.datasets.importing.third_party import Placed, place_third_party
from handover_marl.datasets.official_files import needed_files, stands_in
from handover_marl.errors import DataNotFoundError, HandoverError, ResultsError, SceneError
from handover_marl.files import remove_abandoned
from handover_marl.options import check_workers


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
        OptionError: `workers` is less than one, or PyBullet, of whose table HandoverSim's is made, is not installed.
        ResultsError: The data folder cannot be written, or holds models made of other data.
    """
    n_workers = check_workers(workers)
    table_folder()
    layout = find_sequences(Path(dexycb).expanduser())
    folder = _mano_folder(Path(mano).expanduser())
    models = read_models(folder)
    target = Path(out).expanduser()
    chosen = _chosen(layout.sequences, scenes)
    assets = target / "assets"
    notes = [*layout.ignored, *doubts_about_sides(models["right"], models["left"])]
    if third_party is not None:
        notes += _third_party_notes(place_third_party(Path(third_party).expanduser(), assets))
    hands, faults = _write_models(layout.sequences, models, assets)
    remove_abandoned(target / CACHE_FOLDER)
    done: list[int] = []
    betas = find_first_betas(layout.sequences)
    try:
        with closing(converted(chosen, folder, betas, target, n_workers, progress)) as conversions:
            for sequence, fault in conversions:
                if fault:
                    faults.append(fault)
                else:
                    done.append(sequence.scene_id)
    finally:
        # What workers were writing that were killed on the way, by whomever, or because the import was interrupted.
        remove_abandoned(target / CACHE_FOLDER)
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
    for subject, recordings in groupby(sequences, lambda sequence: sequence.subject):
        try:
            betas = read_hand_betas(list(recordings))
            hands += [write_hand_assets(assets, subject, models[side], betas).name for side in SIDES]
        except ResultsError:
            raise
        except HandoverError as error:
            faults.append(f"hands of {subject}: {error}")
    return hands, faults
