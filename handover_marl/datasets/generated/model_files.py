"""URDF and mesh files of procedural objects and hands, in the user's cache folder.

A folder's name has a hash of its content, so that equal models of different data sets share files.
"""

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path

from handover_marl.assets.hand_model import HANDS_FOLDER, Side, format_hand_urdf, scale_hand
from handover_marl.assets.shipped import (
    COLLISION_NAME,
    URDF_NAME,
    VISUAL_NAME,
    format_object_urdf,
    format_visual,
    read_palette_files,
)
from handover_marl.datasets.generated.hands import Person
from handover_marl.datasets.generated.objects import ProceduralObject
from handover_marl.datasets.generated.shapes import make_surface
from handover_marl.errors import DataNotFoundError, ResultsError
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.array_cache import get_cache_folder
from handover_marl.geometry.model_files.obj_files import format_convex_parts

# Version of the files, part of the hash of their content.
_FORMAT = 1


def write_object_model(name: str, item: ProceduralObject) -> Path:
    """Write the model of an object unless it exists, and return the path of its URDF in a folder of its name.

    Raises:
        DataNotFoundError: The user's cache folder cannot be written.
    """

    def make_files() -> dict[str, bytes | str]:
        surfaces = [(part.color, make_surface(part)) for part in item.parts]
        return {
            COLLISION_NAME: format_convex_parts((surface.vertices, surface.faces) for _, surface in surfaces),
            VISUAL_NAME: format_visual((color, surface.vertices, surface.faces) for color, surface in surfaces),
            **read_palette_files(),
            URDF_NAME: format_object_urdf(),
        }

    return _write_folder(repr(item), name, URDF_NAME, make_files)


def write_hand_model(person: Person, side: Side) -> Path:
    """Write the model of a person's hand unless it exists, and return the path of its URDF.

    Raises:
        DataNotFoundError: The user's cache folder cannot be written.
    """
    meshes, name = str(HANDS_FOLDER / "meshes" / side), f"{person.name}_{side}"

    def make_files() -> dict[str, bytes | str]:
        return {"mano.urdf": format_hand_urdf(scale_hand(person.size, side), name, person.color, meshes)}

    return _write_folder(f"{person!r} {side} {meshes}", name, "mano.urdf", make_files)


def _write_folder(content: str, name: str, urdf: str, make_files: Callable[[], Mapping[str, bytes | str]]) -> Path:
    """Return the path of a URDF in a folder that has a hash of its content; the files are written once, the URDF last.

    Several processes may write the same files.
    """
    digest = hashlib.sha256(f"{_FORMAT} {content}".encode()).hexdigest()[:20]
    root = get_cache_folder("generated")
    folder = root / digest / name
    if not (folder / urdf).is_file():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for file, text in make_files().items():
                write_atomically(folder / file, text)
        except (OSError, ResultsError) as error:
            raise DataNotFoundError(
                f"models of generated scenes cannot be written to {root} ({error}); "
                "set XDG_CACHE_HOME to a folder that can be written"
            ) from error
    return folder / urdf
