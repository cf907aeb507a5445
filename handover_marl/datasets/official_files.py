"""The files of HandoverSim's `assets/` that come from others, and where those of a data folder come from.

`third_party.sha256` lists them by their path in `assets/`, with the sums of those that are known. A stand-in says of
itself that it is one, in its first bytes.
"""

import hashlib
from collections import Counter
from enum import Enum
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Final

from handover_marl.models.panda import PANDA, PANDA_CAMERA

#: Models of the robots.
PANDA_FILES = {
    PANDA: "franka_panda/panda_gripper.urdf",
    PANDA_CAMERA: "franka_panda/panda_gripper_hand_camera.urdf",
}
#: HandoverSim comes without grasps of these; its setups never ask for them.
WITHOUT_GRASPS = ("002_master_chef_can", "036_wood_block")
#: What a file that stands in for an original one has among its first bytes.
STAND_IN: Final = "handover_marl stand-in"
#: Links of the hand, counted from 1, that collide with less than they show: roots of middle, little and ring finger.
SLENDER_LINKS = (5, 8, 11)
N_HAND_MESHES = 16
# Nothing fails for want of colours, nor of the camera's body, which HandoverSim's URDFs name where it is not.
_OPTIONAL_ENDINGS = (".mtl", ".png", "camera.stl", "camera.DAE")
_BEGINNING = 1000  # bytes in which a stand-in says so


class Origin(Enum):
    """Where a file comes from."""

    ORIGINAL = "original"
    STAND_IN = "stand-in"
    UNKNOWN = "unknown"


@cache
def third_party_sums() -> MappingProxyType[str, str | None]:
    """Path in `assets/` -> SHA-256 in hexadecimal, or None for a file that is expected but not known."""
    text = (files(__package__) / "third_party.sha256").read_text()
    pairs = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    return MappingProxyType({path: None if known == "-" else known for known, path in pairs})


def needed_files() -> tuple[str, ...]:
    """Those of them without which scenes cannot be played, by path in `assets/`."""
    return tuple(path for path in third_party_sums() if not path.endswith(_OPTIONAL_ENDINGS))


def is_stand_in(content: bytes) -> bool:
    """Whether a file says that it stands in for an original one."""
    return STAND_IN.encode() in content[:_BEGINNING]


def stands_in(path: Path) -> bool:
    """The same of a file that may be missing or unreadable."""
    try:
        with path.open("rb") as file:
            return is_stand_in(file.read(_BEGINNING))
    except OSError:
        return False


def file_origin(path: str, content: bytes) -> Origin:
    """Where a file comes from, by what it holds.

    Args:
        path: Relative to `assets/`.
        content: What it holds.
    """
    if is_stand_in(content):
        return Origin.STAND_IN
    known = third_party_sums().get(path)
    same = known is not None and hashlib.sha256(content).hexdigest() == known
    return Origin.ORIGINAL if same else Origin.UNKNOWN


def hand_origin(folder: Path) -> Origin:
    """Whether a hand was compiled from a MANO model as HandoverSim does it, or is of another make.

    The compiled hand collides with the very surfaces that it shows, but for three links, and these are open where
    they meet; nobody would make one of bodies so.

    Args:
        folder: The hand's, with `mano.urdf` and `meshes/`.

    Raises:
        OSError: A mesh cannot be read.
    """

    def mesh(kind: str, link: int) -> bytes:
        return (folder / "meshes" / kind / f"mesh{link}.obj").read_bytes()

    links = [link for link in range(1, N_HAND_MESHES + 1) if link not in SLENDER_LINKS]
    compiled = all(mesh("visual", link) == mesh("collision", link) for link in links) and all(
        _vertices(mesh("collision", link)) <= _vertices(mesh("visual", link)) for link in SLENDER_LINKS
    )
    compiled = compiled and _is_open(mesh("visual", 1))
    return Origin.ORIGINAL if compiled else Origin.STAND_IN


def _is_open(mesh: bytes) -> bool:
    """Whether a surface bounds no body."""
    faces = [line.split()[1:] for line in mesh.splitlines() if line.startswith(b"f ")]
    edges = Counter(frozenset(pair) for face in faces for pair in zip(face, [*face[1:], face[0]], strict=True))
    return set(edges.values()) != {2}


def _vertices(mesh: bytes) -> set[bytes]:
    return {line for line in mesh.splitlines() if line.startswith(b"v ")}
