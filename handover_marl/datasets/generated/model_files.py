"""URDF and mesh files of procedural objects and hands, in the user's cache folder.

A folder's name has a hash of its content, so that equal models of different data sets share files. Folders are written
under a temporary name and renamed; the oldest ones are removed when there are too many.
"""

import hashlib
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from handover_marl.assets.hand_model import HANDS_FOLDER, Side, format_hand_urdf, scale_hand
from handover_marl.assets.object_models import (
    COLLISION_NAME,
    URDF_NAME,
    VISUAL_NAME,
    copy_palette,
    format_object_urdf,
    format_visual,
)
from handover_marl.datasets.generated.hands import Person
from handover_marl.datasets.generated.objects import ProceduralObject
from handover_marl.datasets.generated.shapes import make_surface
from handover_marl.errors import DataNotFoundError
from handover_marl.geometry.array_cache import get_cache_folder
from handover_marl.geometry.model_files.obj_files import format_convex_parts

#: Largest number of folders of models; of more, the oldest ones are removed.
MAX_FOLDERS: Final = 20_000
# Folders that were written within this time (s) are kept: simulations may be about to load them.
_KEPT_TIME = 86_400.0
_CHECK_INTERVAL = 1000
_HAND_NAME = "mano.urdf"

_n_written = 0


def write_object_model(name: str, item: ProceduralObject) -> Path:
    """Write the model of an object unless it exists, and return the path of its URDF in a folder of its name.

    Raises:
        DataNotFoundError: The user's cache folder cannot be written.
    """

    def write(folder: Path) -> None:
        meshes = [
            (part.color, surface.vertices, surface.faces) for part in item.parts for surface in [make_surface(part)]
        ]
        (folder / COLLISION_NAME).write_text(format_convex_parts(mesh[1:] for mesh in meshes), newline="\n")
        (folder / VISUAL_NAME).write_text(format_visual(meshes), newline="\n")
        (folder / URDF_NAME).write_text(format_object_urdf(), newline="\n")
        copy_palette(folder)

    return _write_folder(repr(item), name, write) / URDF_NAME


def write_hand_model(person: Person, side: Side) -> Path:
    """Write the model of a person's hand unless it exists, and return the path of its URDF.

    Raises:
        DataNotFoundError: The user's cache folder cannot be written.
    """
    meshes, name = str(HANDS_FOLDER / "meshes" / side), f"{person.name}_{side}"

    def write(folder: Path) -> None:
        text = format_hand_urdf(scale_hand(person.size, side), name, person.color, meshes)
        (folder / _HAND_NAME).write_text(text)

    return _write_folder(f"{person!r} {side} {meshes}", name, write) / _HAND_NAME


def _write_folder(content: str, name: str, write: Callable[[Path], None]) -> Path:
    """Return a folder that `write` fills, named by a hash of its content; it is written once."""
    digest = hashlib.sha256(f"{_FORMAT} {content}".encode()).hexdigest()[:20]
    root = get_cache_folder("generated")
    folder = root / digest / name
    if folder.is_dir():
        return folder
    try:
        root.mkdir(parents=True, exist_ok=True)
        _remove_old_folders(root)
        scratch = Path(tempfile.mkdtemp(prefix=".tmp-", dir=root))
        try:
            (scratch / name).mkdir()
            write(scratch / name)
            (root / digest).mkdir(exist_ok=True)
            _rename(scratch / name, folder)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    except OSError as error:
        raise DataNotFoundError(
            f"models of generated scenes cannot be written to {root} ({error}); "
            "set XDG_CACHE_HOME to a folder that can be written"
        ) from error
    return folder


#: Version of the files, part of the hash of their content.
_FORMAT = 1


def _rename(source: Path, goal: Path) -> None:
    try:
        source.rename(goal)
    except OSError:
        # Another process was faster; its files are the same.
        if not goal.is_dir():
            raise


def _remove_old_folders(root: Path, limit: int = MAX_FOLDERS) -> None:
    """Remove the oldest folders if there are too many; look at every thousandth write of a process."""
    global _n_written
    _n_written += 1
    if _n_written % _CHECK_INTERVAL != 1:
        return
    folders = [path for path in root.iterdir() if path.is_dir()]
    if len(folders) <= limit:
        return
    ages = sorted((path.stat().st_mtime, path) for path in folders if path.exists())
    for changed, path in ages[: len(folders) - limit // 2]:
        if time.time() - changed > _KEPT_TIME:
            shutil.rmtree(path, ignore_errors=True)
