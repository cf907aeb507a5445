"""Many recordings to scenes, in processes of their own."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from handover_marl.datasets.importing.mano_model import SIDES, ManoModel, read_mano_model
from handover_marl.datasets.importing.process_pool import worked_on
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
    sequences: Sequence[SequenceFolder], mano: Path, betas: Betas, out: Path, workers: int, progress: bool
) -> Iterator[tuple[SequenceFolder, str]]:
    """Every recording with what kept it from being imported, empty if nothing did, as they are finished.

    Raises:
        ResultsError: The data folder cannot be written, or a process died.
    """
    # The models are not sent: they are more than a pipe holds.
    return worked_on(_import_one, sequences, "scenes", workers, progress, _start, (mano, betas, out))


_given: tuple[dict[str, ManoModel], Betas, Path]


def _start(mano: Path, betas: Betas, out: Path) -> None:
    """What a process is told once."""
    global _given
    _given = read_models(mano), betas, out


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
