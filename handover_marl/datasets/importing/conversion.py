"""Many recordings to scenes, in processes of their own."""

import functools
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from handover_marl.datasets.importing.mano_model import SIDES, ManoModel, read_mano_model
from handover_marl.datasets.importing.raw_layout import SequenceFolder
from handover_marl.datasets.importing.scene_import import Betas, import_scene
from handover_marl.errors import HandoverError, ResultsError
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on


def read_models(folder: Path) -> dict[str, ManoModel]:
    """MANO's hands by side.

    Raises:
        DataNotFoundError, UnsafeFileError, DataFormatError: As `read_mano_model`.
    """
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in SIDES}


def converted(
    sequences: Sequence[SequenceFolder], mano: Path, betas: Betas, out: Path, workers: int, progress: bool
) -> Generator[tuple[SequenceFolder, str], None, None]:
    """Every recording with what kept it from being imported, empty if nothing did, as they are finished.

    Raises:
        ResultsError: The data folder cannot be written.
        WorkerError: A process died twice over the same recording.
    """

    def prepare() -> Callable[[SequenceFolder], str]:
        return functools.partial(_import_one, read_models(mano), betas, out)

    return worked_on(prepare, sequences, "scenes", PoolConfig(workers), progress)


def _import_one(models: dict[str, ManoModel], betas: Betas, out: Path, sequence: SequenceFolder) -> str:
    try:
        import_scene(sequence, models, betas, out)
    except ResultsError:
        # The data folder's fault, not the recording's: no other scene would do better.
        raise
    except HandoverError as error:
        return f"scene {sequence.scene_id:03d} ({sequence.name}): {error}"
    return ""
