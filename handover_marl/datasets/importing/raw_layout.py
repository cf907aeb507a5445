"""What raw DexYCB looks like on disk, and which scene each of its recordings is.

<raw>/<subject>/<sequence>/meta.yml, pose.npz   (and camera folders, which are not read)
<raw>/calibration/                               extrinsics and hand shapes

A scene's number is 100 * subject + the rank of its recording among the subject's, by name. The rank is only known
when all of a subject's recordings are there.
"""

import re
from dataclasses import dataclass
from pathlib import Path

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
    if not raw.is_dir() or not any((raw / name).is_dir() for name in (*SUBJECTS, "calibration")):
        raise DataNotFoundError(
            f"{raw} is no raw DexYCB folder: it holds neither calibration/ nor a subject such as {SUBJECTS[0]}/. Give "
            "the folder that DexYCB's archives were expanded into."
        )
    sequences: list[SequenceFolder] = []
    missing: list[str] = []
    ignored: list[str] = []
    if not (raw / "calibration").is_dir():
        missing.append(f"{raw / 'calibration'} is missing; expand DexYCB's calibration.tar.gz there")
    for number, subject in enumerate(SUBJECTS):
        found = _find_subject(raw / subject, number)
        sequences += found.sequences
        missing += found.missing
        ignored += found.ignored
    return RawLayout(tuple(sequences), tuple(missing), tuple(ignored))


def _find_subject(folder: Path, number: int) -> RawLayout:
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        return RawLayout((), (f"{folder} {reason}; expand DexYCB's {folder.name}.tar.gz there",), ())
    folders = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    passed = [entry.name for entry in entries if entry not in folders]
    ignored = (f"{folder}: ignored {_listed(passed)}, which HandoverSim would have counted",) if passed else ()
    fault = _fault([entry.name for entry in folders])
    if fault:
        return RawLayout((), (f"{folder} {fault}",), ignored)
    sequences = [
        SequenceFolder(SEQUENCES_PER_SUBJECT * number + rank, f"{folder.name}/{entry.name}", entry)
        for rank, entry in enumerate(folders)
    ]
    lacking = {sequence: _lacking(sequence) for sequence in sequences}
    return RawLayout(
        tuple(sequence for sequence in sequences if not lacking[sequence]),
        tuple(text for text in lacking.values() if text),
        ignored,
    )


def _fault(names: list[str]) -> str:
    """Why folders of these names do not tell the scene numbers; empty if they do."""
    strangers = [name for name in names if not _SEQUENCE_NAME.fullmatch(name)]
    if strangers:
        return f"holds {_listed(strangers)}, which no recording is called; remove what is not DexYCB's"
    if len(names) != SEQUENCES_PER_SUBJECT:
        remedy = "complete the download" if len(names) < SEQUENCES_PER_SUBJECT else "remove what is not DexYCB's"
        return (
            f"holds {len(names)} recordings instead of {SEQUENCES_PER_SUBJECT}, so that their scene numbers, which "
            f"are ranks, are unknown; {remedy}"
        )
    return ""


def _lacking(sequence: SequenceFolder) -> str:
    files = [name for name in (META_FILE, POSE_FILE) if not (sequence.folder / name).is_file()]
    if not files:
        return ""
    return f"{sequence.folder} lacks {' and '.join(files)}; expand DexYCB's {sequence.subject}.tar.gz again"


def _listed(names: list[str]) -> str:
    shown = ", ".join(map(repr, names[:3]))
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
