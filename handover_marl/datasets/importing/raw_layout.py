"""What raw DexYCB looks like on disk, and which scene each of its recordings is.

<raw>/<subject>/<sequence>/meta.yml, pose.npz   (and camera folders, which are not read)
<raw>/calibration/                               extrinsics and hand shapes

A scene's number is 100 * subject + the rank of its recording among the subject's, by name. Recordings that are called
as DexYCB's are have the rank that they have there, whichever are missing. A subject whose recordings are called
otherwise must have all hundred.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from handover_marl.datasets.importing.sequence_names import SEQUENCE_NAMES
from handover_marl.errors import DataNotFoundError
from handover_marl.models.ycb import SUBJECTS

#: Recordings of every subject.
SEQUENCES_PER_SUBJECT = 100
META_FILE = "meta.yml"
POSE_FILE = "pose.npz"
_SEQUENCE_NAME = re.compile(r"\d{8}_\d{6}")


@dataclass(frozen=True)
class SequenceFolder:
    """Where one recording lies.

    Attributes:
        scene_id: Number of its scene, 0 to 999.
        name: `<subject>/<sequence>`.
        folder: The folder that holds its meta.yml and pose.npz.
    """

    scene_id: int
    name: str
    folder: Path

    @property
    def subject(self) -> str:
        """The person, e.g. `20200709-subject-01`."""
        return self.name.partition("/")[0]

    @property
    def calibration(self) -> Path:
        """The dataset's folder of extrinsics and hand shapes."""
        return self.folder.parents[1] / "calibration"


@dataclass(frozen=True)
class RawLayout:
    """What was found.

    Attributes:
        sequences: Recordings that can be imported, by ascending scene number.
        missing: What cannot, one sentence each that says where, why and what to do.
        ignored: Files and hidden entries among the recordings that were passed over, one sentence a subject.
    """

    sequences: tuple[SequenceFolder, ...]
    missing: tuple[str, ...]
    ignored: tuple[str, ...]


def find_sequences(raw: Path) -> RawLayout:
    """All recordings of a raw DexYCB folder, complete or not.

    Raises:
        DataNotFoundError: There is no such folder, or it holds neither a subject nor the calibration.
    """
    if not _is_folder(raw) or not any(_is_folder(raw / name) for name in (*SUBJECTS, "calibration")):
        raise DataNotFoundError(
            f"{raw} is no raw DexYCB folder: it holds neither calibration/ nor a subject such as {SUBJECTS[0]}/. Give "
            "the folder that DexYCB's archives were expanded into."
        )
    sequences: list[SequenceFolder] = []
    missing: list[str] = []
    ignored: list[str] = []
    if not _is_folder(raw / "calibration"):
        missing.append(
            f"{raw / 'calibration'} is missing, without which no recording can be imported; expand DexYCB's "
            "calibration.tar.gz there"
        )
    for number, subject in enumerate(SUBJECTS):
        found = _find_subject(raw / subject, number)
        sequences += found.sequences
        missing += found.missing
        ignored += found.ignored
    # One sentence instead of a thousand.
    usable = sequences if _is_folder(raw / "calibration") else []
    return RawLayout(tuple(usable), tuple(missing), tuple(ignored))


def _find_subject(folder: Path, number: int) -> RawLayout:
    try:
        entries = sorted(folder.iterdir())
        folders = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    except OSError as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        return RawLayout((), (f"{folder} {reason}; expand DexYCB's {folder.name}.tar.gz there",), ())
    passed = [entry.name for entry in entries if entry not in folders]
    ignored = (f"{folder}: ignored {_listed(passed)}, which HandoverSim would have counted",) if passed else ()
    ranks, faults = _ranks(folder.name, [entry.name for entry in folders])
    found = [
        SequenceFolder(SEQUENCES_PER_SUBJECT * number + ranks[entry.name], f"{folder.name}/{entry.name}", entry)
        for entry in folders
        if entry.name in ranks
    ]
    lacking = {sequence: _lacking(sequence) for sequence in found}
    return RawLayout(
        tuple(sequence for sequence in found if not lacking[sequence]),
        (*(f"{folder} {fault}" for fault in faults), *(text for text in lacking.values() if text)),
        ignored,
    )


def _ranks(subject: str, names: list[str]) -> tuple[dict[str, int], list[str]]:
    """Ranks of a subject's recordings by their names, sorted, and what is wrong with these."""
    known = {name: rank for rank, name in enumerate(SEQUENCE_NAMES[subject]) if name in set(names)}
    # Other data may have a name or two of DexYCB's by chance, which tell nothing.
    if 2 * len(known) > len(names):
        return known, [fault for fault in (_strangers(known, names), _absent(subject, known)) if fault]
    strangers = [name for name in names if not _SEQUENCE_NAME.fullmatch(name)]
    if strangers:
        return {}, [f"holds {_listed(strangers)}, which no recording is called; remove what is not DexYCB's"]
    if len(names) != SEQUENCES_PER_SUBJECT:
        remedy = "complete the download" if len(names) < SEQUENCES_PER_SUBJECT else "remove what is not DexYCB's"
        return {}, [
            f"holds {len(names)} recordings instead of {SEQUENCES_PER_SUBJECT}, so that their scene numbers, which "
            f"are ranks, are unknown; {remedy}"
        ]
    return {name: rank for rank, name in enumerate(names)}, []


def _strangers(known: dict[str, int], names: list[str]) -> str:
    strangers = [name for name in names if name not in known]
    if not strangers:
        return ""
    return f"holds {_listed(strangers)} beside DexYCB's recordings, which was left out; remove what is not DexYCB's"


def _absent(subject: str, known: dict[str, int]) -> str:
    absent = [name for name in SEQUENCE_NAMES[subject] if name not in known]
    if not absent:
        return ""
    return (
        f"lacks {_listed(absent)}, {len(absent)} of {SEQUENCES_PER_SUBJECT} recordings; expand DexYCB's "
        f"{subject}.tar.gz again"
    )


def _lacking(sequence: SequenceFolder) -> str:
    try:
        files = [name for name in (META_FILE, POSE_FILE) if not (sequence.folder / name).is_file()]
    except OSError as error:
        return f"{sequence.folder} cannot be read ({error.strerror}); check its rights"
    if not files:
        return ""
    return f"{sequence.folder} lacks {' and '.join(files)}; expand DexYCB's {sequence.subject}.tar.gz again"


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # a folder above it may not be entered
        return False


def _listed(names: list[str]) -> str:
    shown = ", ".join(map(repr, names[:3]))
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
