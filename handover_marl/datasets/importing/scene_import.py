"""One recording of raw DexYCB to one scene of HandoverSim's cache; scenes do not depend on each other."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from handover_marl.datasets.importing.cache_writer import CACHE_FOLDER, CachedScene, write_scene
from handover_marl.datasets.importing.hand_motion import hand_trajectory
from handover_marl.datasets.importing.mano_model import ManoModel
from handover_marl.datasets.importing.object_motion import object_trajectory
from handover_marl.datasets.importing.raw_calibration import read_betas
from handover_marl.datasets.importing.raw_layout import SEQUENCES_PER_SUBJECT, SequenceFolder
from handover_marl.datasets.importing.raw_sequence import RawSequence, read_meta, read_sequence
from handover_marl.datasets.importing.sequence_names import SEQUENCE_NAMES
from handover_marl.datasets.importing.tag_frame import TagFrame
from handover_marl.errors import DataFormatError, DataNotFoundError, ResultsError

#: Shape parameters by subject and side.
Betas = Mapping[tuple[str, str], tuple[float, ...]]


def find_first_betas(sequences: Iterable[SequenceFolder]) -> dict[tuple[str, str], tuple[float, ...]]:
    """Shape parameters of the hand that each subject's articulated hand is made from, by subject and side.

    They are those of the first recording of that subject and side. In DexYCB all are equal, so one that cannot be
    read is passed over here; importing it tells what is wrong with it.

    Args:
        sequences: Recordings by ascending scene number.
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


def read_hand_betas(sequences: Sequence[SequenceFolder]) -> tuple[float, ...]:
    """Shape parameters that the models of a subject's two hands are made from.

    They are those of the subject's first recording, whichever hand that shows. In DexYCB all are equal, so that any
    of its recordings will do if that one is missing or damaged.

    Args:
        sequences: Recordings of one subject, at least one, by ascending scene number.

    Raises:
        DataNotFoundError: The first recording is missing, or its meta.yml or its calibration.
        DataFormatError: One of these files is damaged.
    """
    faults = []
    for sequence in sequences:
        known = sequence.folder.name in SEQUENCE_NAMES[sequence.subject]
        if sequence.scene_id % SEQUENCES_PER_SUBJECT and not known:
            break
        try:
            return read_betas(sequence.calibration, read_meta(sequence).mano_calib)
        except (DataNotFoundError, DataFormatError) as error:
            faults.append(error)
    if faults:
        raise faults[0]
    raise DataNotFoundError(
        f"{sequences[0].folder.parent} lacks its first recording, from which they are made; complete the download"
    )


def import_scene(sequence: SequenceFolder, models: Mapping[str, ManoModel], first_betas: Betas, out: Path) -> None:
    """Write one scene's two files.

    Args:
        sequence: The recording.
        models: MANO's hands by side, "right" and "left".
        first_betas: As `find_first_betas` gives them, of all recordings of the subject.
        out: The data folder, which gets `dex-ycb-cache/`.

    Raises:
        DataNotFoundError: A file of the recording is missing.
        DataFormatError: One is damaged, or a file of the scene exists with other content.
        ResultsError: A file cannot be written.
    """
    scene = convert(sequence, read_sequence(sequence), models, first_betas)
    cache = out / CACHE_FOLDER
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultsError(f"cannot make the folder {cache} ({error.strerror or error}); choose another") from error
    write_scene(scene, cache)


def convert(
    sequence: SequenceFolder, raw: RawSequence, models: Mapping[str, ManoModel], first_betas: Betas
) -> CachedScene:
    """A scene from what `read_sequence` gave; the other arguments as `import_scene`."""
    meta, model, tag = raw.meta, models[raw.meta.side], TagFrame.from_extrinsics(raw.world_from_tag)
    base = model.wrist(first_betas.get((sequence.subject, meta.side), raw.betas))
    objects = [object_trajectory(raw.objects[:, number], tag) for number in range(raw.objects.shape[1])]
    hand = hand_trajectory(raw.hand, tag, model, model.wrist(raw.betas), base)
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
