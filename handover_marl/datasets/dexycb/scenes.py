"""Import of raw DexYCB recordings as scenes of HandoverSim's cache `dex-ycb-cache/`.

The import of a scene depends on no other scene, so scenes can be imported in parallel.
"""

import functools
import json
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.datasets.dexycb.mano import SIDES, ManoModel, read_mano_model
from handover_marl.datasets.dexycb.motion import compute_hand_trajectory, compute_object_trajectory
from handover_marl.datasets.dexycb.raw_files import RawSequence, SequenceFolder, read_betas, read_meta, read_sequence
from handover_marl.datasets.dexycb.rotations import Float32, TagFrame
from handover_marl.datasets.scene_files import CACHE_FOLDER, MAX_MOTION_BYTES
from handover_marl.errors import DataFormatError, DataNotFoundError, HandoverError, ResultsError
from handover_marl.execution.files import has_content, write_arrays, write_atomically
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.reading import read_arrays
from handover_marl.execution.tasks import map_with_progress

#: MANO's 10 shape parameters by subject and side.
BetasBySubject = Mapping[tuple[str, str], tuple[float, ...]]


def find_first_betas(sequences: Iterable[SequenceFolder]) -> dict[tuple[str, str], tuple[float, ...]]:
    """Return MANO's shape parameters by subject and side, from the first readable recording of each.

    HandoverSim places the root joint of a subject's hand model by the parameters of the first recording. In DexYCB
    the parameters of all recordings of a subject are equal, so unreadable recordings are skipped. Of a subject, the
    side of the first readable recording is first.
    """
    first: dict[tuple[str, str], tuple[float, ...]] = {}
    for sequence in sequences:
        if {(sequence.subject, "right"), (sequence.subject, "left")} <= first.keys():
            continue
        try:
            meta = read_meta(sequence)
            if (sequence.subject, meta.side) not in first:
                first[sequence.subject, meta.side] = read_betas(sequence.calibration, meta.mano_calib)
        except (DataNotFoundError, DataFormatError):
            continue
    return first


def read_mano_models(folder: Path) -> dict[str, ManoModel]:
    """Read MANO's models of both hands, by side.

    Raises:
        DataNotFoundError: A model file is missing.
        UnsafeFileError: A model file may run code.
        DataFormatError: A model file is damaged.
    """
    return {side: read_mano_model(folder / f"MANO_{side.upper()}.pkl", side) for side in SIDES}


def import_scenes(
    sequences: Sequence[SequenceFolder], mano: Path, betas: BetasBySubject, out: Path, workers: int, progress: bool
) -> Generator[tuple[SequenceFolder, str], None, None]:
    """Import recordings in worker processes; yield each as it is finished, with an error message or "".

    Raises:
        ResultsError: The data folder cannot be written.
        WorkerError: A worker process died twice on the same recording.
    """

    def prepare() -> Callable[[SequenceFolder], str]:
        return functools.partial(_import_sequence, read_mano_models(mano), betas, out)

    return map_with_progress(prepare, sequences, "scenes", PoolConfig(workers), progress)


def _import_sequence(models: dict[str, ManoModel], betas: BetasBySubject, out: Path, sequence: SequenceFolder) -> str:
    try:
        import_scene(sequence, models, betas, out)
    except ResultsError:
        # An unwritable data folder concerns all scenes.
        raise
    except HandoverError as error:
        return f"scene {sequence.scene_id:03d} ({sequence.name}): {error}"
    return ""


def import_scene(
    sequence: SequenceFolder, models: Mapping[str, ManoModel], first_betas: BetasBySubject, out: Path
) -> None:
    """Import one recording: write the two files of its scene to `dex-ycb-cache/` in a data folder.

    Raises:
        DataNotFoundError, DataFormatError: A file of the recording is missing or damaged, or one of the scene differs.
        ResultsError: A file cannot be written.
    """
    scene = convert_sequence(sequence, read_sequence(sequence), models, first_betas)
    cache = out / CACHE_FOLDER
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot make the folder {cache} ({error.strerror or error}); choose another") from error
    write_scene(scene, cache)


@dataclass(frozen=True, eq=False)
class CachedScene:
    """Content of a scene's two files in the cache.

    Attributes:
        scene_id: Scene number.
        meta: Content of the meta file, keys in the official order.
        pose_y: (T, n, 6) float32 motion of the n objects at 1 kHz in the frame of the AprilTag on the
            table: position (m), intrinsic XYZ Euler angles (rad).
        pose_m: (T, 1, 51) float32 joint positions of the hand at 1 kHz in the same frame: 3 positions (m),
            48 angles (rad).
    """

    scene_id: int
    meta: dict[str, Any]
    pose_y: Float32
    pose_m: Float32


def convert_sequence(
    sequence: SequenceFolder, raw: RawSequence, models: Mapping[str, ManoModel], first_betas: BetasBySubject
) -> CachedScene:
    """Convert a recording to a scene, with the shape parameters of `find_first_betas`."""
    meta, model, tag = raw.meta, models[raw.meta.side], TagFrame.from_extrinsics(raw.world_from_tag)
    base = model.locate_wrist(first_betas.get((sequence.subject, meta.side), raw.betas))
    objects = [compute_object_trajectory(raw.objects[:, number], tag) for number in range(raw.objects.shape[1])]
    hand = compute_hand_trajectory(raw.hand, tag, model, model.locate_wrist(raw.betas), base)
    return CachedScene(
        scene_id=sequence.scene_id,
        meta={
            "name": sequence.name,
            "ycb_ids": list(meta.ycb_ids),
            "ycb_grasp_ind": meta.ycb_grasp_ind,
            "mano_sides": [meta.side],
            "mano_betas": [list(raw.betas)],
        },
        pose_y=np.stack(objects, axis=1),
        pose_m=hand[:, None],
    )


def write_scene(scene: CachedScene, cache: Path) -> None:
    """Write the files meta_NNN.json and pose_NNN.npz of a scene; existing files must be equal.

    Raises:
        DataFormatError: A file exists with other content.
        ResultsError: A file cannot be written.
    """
    arrays = {"pose_y": np.ascontiguousarray(scene.pose_y), "pose_m": np.ascontiguousarray(scene.pose_m)}
    pose = cache / f"pose_{scene.scene_id:03d}.npz"
    # The meta file is written last: it marks the scene as complete.
    meta, text = cache / f"meta_{scene.scene_id:03d}.json", json.dumps(scene.meta).encode()
    if not pose.exists():
        write_arrays(pose, arrays)
    elif not _has_arrays(pose, arrays):
        raise _make_mismatch_error(pose)
    if not meta.exists():
        write_atomically(meta, text)
    elif not has_content(meta, text):
        raise _make_mismatch_error(meta)


def _make_mismatch_error(path: Path) -> DataFormatError:
    return DataFormatError(
        f"{path} exists, but differs from the result of this recording; remove it to have it written again, or "
        "choose another folder"
    )


def _has_arrays(path: Path, expected: dict[str, Float32]) -> bool:
    # The bytes of the archive depend on the time and the compressor, so arrays are compared.
    try:
        found = read_arrays(path, tuple(expected), MAX_MOTION_BYTES)
    except Exception:  # NumPy and zipfile raise exceptions of many types on damaged files
        return False
    # As bytes, since 0.0 equals -0.0.
    return all(
        found[name].shape == array.shape and found[name].tobytes() == array.tobytes()
        for name, array in expected.items()
    )
