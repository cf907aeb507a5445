"""Import of raw DexYCB, MANO and HandoverSim's third-party archive into a data folder."""

import functools
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from handover_marl.datasets.dexycb.assets import (
    ARCHIVE_NAME,
    find_table_folder,
    install_third_party,
    write_hand_assets,
    write_object_assets,
    write_stand_ins,
    write_table_assets,
)
from handover_marl.datasets.dexycb.mano import SIDES, ManoModel, read_mano_models
from handover_marl.datasets.dexycb.scenes import (
    BetasBySubject,
    SequenceFolder,
    find_first_betas,
    find_sequences,
    import_scene,
)
from handover_marl.datasets.official import CACHE_FOLDER, is_stand_in_file, list_required_files
from handover_marl.datasets.splits import N_SCENES, choose_scenes
from handover_marl.errors import HandoverError, ResultsError
from handover_marl.execution.files import remove_stale_temporaries
from handover_marl.execution.options import PoolConfig, check_path, resolve_worker_count
from handover_marl.execution.pool import map_with_progress


@dataclass(frozen=True)
class ImportReport:
    """Result of `import_dexycb`; `str(report)` is a summary for the terminal.

    Attributes:
        out: Path of the data folder.
        scenes: Scene numbers that were imported or already present, in ascending order.
        hands: Names of the hand models' folders in `assets/`.
        faults: Messages on recordings and files that could not be imported, with path, reason and advice.
        notes: Warnings about files that were imported.
        missing_files: Third-party files that are still missing, relative to `assets/`.
        stand_in_files: Files that replace third-party files, relative to `assets/`.
    """

    out: Path
    scenes: tuple[int, ...]
    hands: tuple[str, ...]
    faults: tuple[str, ...]
    notes: tuple[str, ...]
    missing_files: tuple[str, ...]
    stand_in_files: tuple[str, ...]

    def __str__(self) -> str:
        lines = [f"{self.out}: {len(self.scenes)} scenes, {len(self.hands)} hands."]
        lines += [f"not imported: {fault}" for fault in self.faults]
        lines += [f"note: {text}" for text in self.notes]
        if self.stand_in_files:
            lines.append(
                f"{len(self.stand_in_files)} files stand in for those of {ARCHIVE_NAME}, such as "
                f"{self.stand_in_files[0]}; results on them say so. With --third-party the original ones take their "
                "place."
            )
        if self.missing_files:
            lines.append(
                f"{len(self.missing_files)} files come from neither DexYCB nor MANO, such as {self.missing_files[0]}: "
                f"give HandoverSim's {ARCHIVE_NAME}, or the folder that it was unpacked into, as --third-party"
            )
        lines.append(f"Check the folder with: handover-marl doctor --data-dir {self.out}")
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
) -> ImportReport:
    """Import DexYCB into a data folder; scenes and hands equal the output of HandoverSim's scripts bit for bit.

    Existing files are compared and kept, so an interrupted import can be resumed. Missing or damaged
    recordings are reported; other recordings keep their official scene numbers.

    Args:
        dexycb: Folder that DexYCB's archives were expanded into.
        mano: Folder with `MANO_RIGHT.pkl` and `MANO_LEFT.pkl`, or with both in `models/`.
        out: Data folder to create or to complete, with `dex-ycb-cache/` and `assets/`.
        third_party: HandoverSim's archive (tar) of meshes and grasps, or the folder that it was unpacked into. Without
            it, if `dexycb` has the folder `models/`, its meshes are copied and substitutes (stand-ins) are written:
            convex parts by CoACD (extra `import`), the library's grasps and PyBullet's Panda.
        scenes: Scene numbers to import; default: all.
        workers: Number of worker processes; default: one per core.
        progress: Whether to show a progress bar on stderr.

    Raises:
        DataNotFoundError, DataFormatError: MANO's files, `calibration/` or `third_party` are missing or damaged.
        OptionError, SceneError: An argument is invalid, or PyBullet, whose table is copied, is not installed.
        ResultsError: A file cannot be written, or a model file exists with other content.
    """
    n_workers = resolve_worker_count(workers)
    find_table_folder()
    raw, target = check_path("dexycb", dexycb), check_path("out", out)
    archive = None if third_party is None else check_path("third_party", third_party)
    sequences, missing = find_sequences(raw)
    folder = check_path("mano", mano)
    folder = folder / "models" if (folder / "models").is_dir() else folder
    models = read_mano_models(folder)
    wanted = choose_scenes(tuple(range(N_SCENES)), scenes, "DexYCB")
    chosen = [sequence for sequence in sequences if sequence.scene_id in wanted]
    assets = target / "assets"
    notes = [] if archive is None else install_third_party(archive, assets)
    betas, faults = find_first_betas(sequences), list[str]()
    hands = _write_models(betas, models, assets)
    remove_stale_temporaries(target / CACHE_FOLDER)

    def prepare() -> Callable[[SequenceFolder], str]:
        return functools.partial(_import_sequence, read_mano_models(folder), betas, target)

    imported: list[int] = []
    for sequence, fault in map_with_progress(prepare, chosen, "scenes", PoolConfig(n_workers), progress):
        if fault:
            faults.append(fault)
        else:
            imported.append(sequence.scene_id)
    if archive is None:
        faults += write_stand_ins(raw / "models", assets, n_workers, progress)
    required = list_required_files()
    return ImportReport(
        out=target,
        scenes=tuple(sorted(imported)),
        hands=tuple(hands),
        faults=(*missing, *sorted(faults)),
        notes=tuple(notes),
        missing_files=tuple(path for path in required if not (assets / path).is_file()),
        stand_in_files=tuple(path for path in required if is_stand_in_file(assets / path)),
    )


def _import_sequence(models: dict[str, ManoModel], betas: BetasBySubject, out: Path, sequence: SequenceFolder) -> str:
    """Import a recording; return "" or an error message, but raise `ResultsError` if a file cannot be written."""
    try:
        import_scene(sequence, models, betas, out)
    except ResultsError:
        # An unwritable data folder concerns all scenes.
        raise
    except HandoverError as error:
        return f"scene {sequence.scene_id:03d} ({sequence.name}): {error}"
    return ""


def _write_models(betas: BetasBySubject, models: dict[str, ManoModel], assets: Path) -> list[str]:
    """Write URDFs of objects and table, and two hands per subject, to `assets`; return the hands' folder names."""
    write_object_assets(assets)
    write_table_assets(assets)
    # HandoverSim uses the parameters of the subject's first recording for both hands.
    first = dict[str, tuple[float, ...]]()
    for (subject, _), values in betas.items():
        first.setdefault(subject, values)
    return [
        write_hand_assets(assets, subject, models[side], first[subject]).name
        for subject in sorted(first)
        for side in SIDES
    ]
