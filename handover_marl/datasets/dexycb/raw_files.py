"""Recordings in a folder of raw DexYCB, and their scene numbers.

<raw>/<subject>/<sequence>/meta.yml, pose.npz   (camera folders are not read)
<raw>/calibration/                              camera extrinsics and hand shapes

A scene number is 100 * subject + the rank of the recording's name among the names of the subject's
recordings. Known DexYCB names have their official rank, even if other recordings are missing. A
subject with other names must have all 100 recordings.
"""

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

from handover_marl.datasets.official_files import is_folder
from handover_marl.errors import DataNotFoundError
from handover_marl.geometry.ycb import SUBJECTS

SEQUENCES_PER_SUBJECT = 100
META_FILE = "meta.yml"
POSE_FILE = "pose.npz"
_SEQUENCE_NAME = re.compile(r"\d{8}_\d{6}")


@dataclass(frozen=True)
class SequenceFolder:
    """Folder of one recording.

    Attributes:
        scene_id: Scene number, 0 to 999.
        name: `<subject>/<sequence>`.
        folder: Folder with `meta.yml` and `pose.npz`.
    """

    scene_id: int
    name: str
    folder: Path

    @property
    def subject(self) -> str:
        """Name of the subject, e.g. `20200709-subject-01`."""
        return self.name.partition("/")[0]

    @property
    def calibration(self) -> Path:
        """Folder of the camera extrinsics and hand shapes."""
        return self.folder.parents[1] / "calibration"


@dataclass(frozen=True)
class RawLayout:
    """Recordings found in a folder of raw DexYCB.

    Attributes:
        sequences: Recordings that can be imported, in the order of their scene numbers.
        missing: Messages on what cannot be imported, with path, reason and advice.
        ignored: Messages on files and hidden entries among the recordings, one per subject.
    """

    sequences: tuple[SequenceFolder, ...]
    missing: tuple[str, ...]
    ignored: tuple[str, ...]


@cache
def read_sequence_names() -> MappingProxyType[str, tuple[str, ...]]:
    """Return the names of DexYCB's 100 recordings of every subject, in order of scene number."""
    lines = (files(__package__) / "sequence_names.txt").read_text().splitlines()
    pairs = [line.split("/") for line in lines if not line.startswith("#")]
    return MappingProxyType({subject: tuple(name for owner, name in pairs if owner == subject) for subject in SUBJECTS})


def find_sequences(raw: Path) -> RawLayout:
    """Find all recordings in a folder of raw DexYCB, complete or not.

    Raises:
        DataNotFoundError: The folder is missing, or holds neither a subject nor the calibration.
    """
    if not is_folder(raw) or not any(is_folder(raw / name) for name in (*SUBJECTS, "calibration")):
        raise DataNotFoundError(
            f"{raw} is no raw DexYCB folder: it holds neither calibration/ nor a subject such as {SUBJECTS[0]}/. Give "
            "the folder that DexYCB's archives were expanded into."
        )
    subjects = [_find_subject(raw / subject, number) for number, subject in enumerate(SUBJECTS)]
    sequences = [sequence for subject in subjects for sequence in subject.sequences]
    missing = [message for subject in subjects for message in subject.missing]
    ignored = tuple(message for subject in subjects for message in subject.ignored)
    if not is_folder(raw / "calibration"):
        # One message instead of one per recording.
        sequences = []
        missing.insert(
            0,
            f"{raw / 'calibration'} is missing, without which no recording can be imported; expand DexYCB's "
            "calibration.tar.gz there",
        )
    return RawLayout(tuple(sequences), tuple(missing), ignored)


def _find_subject(folder: Path, number: int) -> RawLayout:
    try:
        entries = sorted(folder.iterdir())
        folders = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    except OSError as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        return RawLayout((), (f"{folder} {reason}; expand DexYCB's {folder.name}.tar.gz there",), ())
    others = [entry.name for entry in entries if entry not in folders]
    ignored = (f"{folder}: ignored {_format_names(others)}, which HandoverSim would have counted",) if others else ()
    ranks, faults = _rank_sequences(folder.name, [entry.name for entry in folders])
    found = [
        SequenceFolder(SEQUENCES_PER_SUBJECT * number + ranks[entry.name], f"{folder.name}/{entry.name}", entry)
        for entry in folders
        if entry.name in ranks
    ]
    incomplete = {sequence: _describe_missing_files(sequence) for sequence in found}
    return RawLayout(
        tuple(sequence for sequence in found if not incomplete[sequence]),
        (*(f"{folder} {fault}" for fault in faults), *(message for message in incomplete.values() if message)),
        ignored,
    )


def _rank_sequences(subject: str, names: list[str]) -> tuple[dict[str, int], list[str]]:
    """Return the ranks of a subject's recordings by name, and messages on faults of the names."""
    known = {name: rank for rank, name in enumerate(read_sequence_names()[subject]) if name in set(names)}
    # Other recordings may share a few names with DexYCB's by chance.
    if 2 * len(known) > len(names):
        return known, _describe_differences(subject, known, names)
    invalid = [name for name in names if not _SEQUENCE_NAME.fullmatch(name)]
    if invalid:
        return {}, [f"holds {_format_names(invalid)}, which no recording is called; remove what is not DexYCB's"]
    if len(names) != SEQUENCES_PER_SUBJECT:
        remedy = "complete the download" if len(names) < SEQUENCES_PER_SUBJECT else "remove what is not DexYCB's"
        return {}, [
            f"holds {len(names)} recordings instead of {SEQUENCES_PER_SUBJECT}, so that their scene numbers, which "
            f"are ranks, are unknown; {remedy}"
        ]
    return {name: rank for rank, name in enumerate(names)}, []


def _describe_differences(subject: str, known: dict[str, int], names: list[str]) -> list[str]:
    faults = []
    unknown = [name for name in names if name not in known]
    if unknown:
        faults.append(
            f"holds {_format_names(unknown)} beside DexYCB's recordings, which was left out; remove what is not "
            "DexYCB's"
        )
    absent = [name for name in read_sequence_names()[subject] if name not in known]
    if absent:
        faults.append(
            f"lacks {_format_names(absent)}, {len(absent)} of {SEQUENCES_PER_SUBJECT} recordings; expand DexYCB's "
            f"{subject}.tar.gz again"
        )
    return faults


def _describe_missing_files(sequence: SequenceFolder) -> str:
    try:
        missing = [name for name in (META_FILE, POSE_FILE) if not (sequence.folder / name).is_file()]
    except OSError as error:
        return f"{sequence.folder} cannot be read ({error.strerror}); check its rights"
    if not missing:
        return ""
    return f"{sequence.folder} lacks {' and '.join(missing)}; expand DexYCB's {sequence.subject}.tar.gz again"


def _format_names(names: list[str]) -> str:
    listed = ", ".join(map(repr, names[:3]))
    return listed if len(names) <= 3 else f"{listed} and {len(names) - 3} more"
