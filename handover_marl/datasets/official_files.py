"""Third-party files in HandoverSim's folder `assets/`, and the origin of such files in a data folder.

`third_party.sha256` lists their paths within `assets/` with the known checksums. A stand-in file
(a substitute made by this library) is marked as such in its first bytes.
"""

import hashlib
from collections import Counter
from enum import Enum
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Final

from handover_marl.execution.reading import check_plain_file, read_plain_file, report_damage
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA

#: URDFs of the robot's variants, relative to `assets/`.
PANDA_FILES = {PANDA: "franka_panda/panda_gripper.urdf", PANDA_CAMERA: "franka_panda/panda_gripper_hand_camera.urdf"}
#: Text among the first bytes of a stand-in file.
STAND_IN: Final = "handover_marl stand-in"
# Scenes run without textures, and without the camera's body, which HandoverSim's URDFs name at a
# path that does not exist.
_OPTIONAL_ENDINGS = (".mtl", ".png", "camera.stl", "camera.DAE")
_HEADER_BYTES = 1000


class FileOrigin(Enum):
    """Origin of a model or grasp file: HandoverSim's, a stand-in (a substitute made by this library), or unknown."""

    ORIGINAL = "original"
    STAND_IN = "stand-in"
    UNKNOWN = "unknown"


@cache
def read_third_party_checksums() -> MappingProxyType[str, str | None]:
    """Return the SHA-256 (hexadecimal) of every third-party file by its path in `assets/`; None if it is unknown."""
    text = (files(__package__) / "third_party.sha256").read_text()
    pairs = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    return MappingProxyType({path: None if known == "-" else known for known, path in pairs})


def list_required_files() -> tuple[str, ...]:
    """Return the third-party files that scenes need, as paths in `assets/`."""
    return tuple(path for path in read_third_party_checksums() if not path.endswith(_OPTIONAL_ENDINGS))


def classify_file_origin(path: str, content: bytes) -> FileOrigin:
    """Return STAND_IN if the content is marked so, ORIGINAL if it has the known checksum of `path`, else UNKNOWN."""
    if STAND_IN.encode() in content[:_HEADER_BYTES]:
        return FileOrigin.STAND_IN
    known = read_third_party_checksums().get(path)
    same = known is not None and hashlib.sha256(content).hexdigest() == known
    return FileOrigin.ORIGINAL if same else FileOrigin.UNKNOWN


def find_hand_origin(folder: Path) -> FileOrigin:
    """Return ORIGINAL for the folder of a hand compiled from MANO, else STAND_IN; UNKNOWN if it cannot be read.

    The palm of a compiled hand is an open surface: some edges belong to one triangle. Other hands have closed meshes.
    """
    try:
        lines = read_plain_file(folder / "meshes" / "visual" / "mesh1.obj").splitlines()
    except (OSError, ValueError):
        return FileOrigin.UNKNOWN
    faces = [line.split()[1:] for line in lines if line.startswith(b"f ")]
    edges = Counter(frozenset(pair) for face in faces for pair in zip(face, [*face[1:], *face[:1]], strict=True))
    return FileOrigin.STAND_IN if all(count == 2 for count in edges.values()) else FileOrigin.ORIGINAL


def find_origin(assets: Path, path: str) -> FileOrigin:
    """Return the origin of a third-party file by its path in the folder `assets`; UNKNOWN if it cannot be read."""
    try:
        return classify_file_origin(path, read_plain_file(assets / path))
    except (OSError, ValueError):
        return FileOrigin.UNKNOWN


def is_stand_in_file(path: Path) -> bool:
    """Return whether a file is a stand-in, a substitute made by this library; False if it cannot be read."""
    return find_origin(path.parent, path.name) is FileOrigin.STAND_IN


def describe_origins(kind: str, *origins: FileOrigin) -> list[str]:
    """Return a note on files of a kind, e.g. "grasps", from the origin of each file, as a list of one or no text.

    The note is "stand-in KIND" if a file is a stand-in, else "KIND of unknown origin" if an origin is unknown.
    """
    if FileOrigin.STAND_IN in origins:
        return [f"stand-in {kind}"]
    return [f"{kind} of unknown origin"] if FileOrigin.UNKNOWN in origins else []


_FILE_ADVICE = "list what is missing with handover-marl doctor, and copy or expand the HandoverSim data again"


def require_file(path: Path, advice: str = _FILE_ADVICE) -> Path:
    """Return `path` if it is a readable file; else raise `DataNotFoundError` or `DataFormatError`, with `advice`."""
    with report_damage(path, "file", advice):
        check_plain_file(path)
    return path
