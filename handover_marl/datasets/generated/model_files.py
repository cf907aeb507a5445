"""URDF and mesh files of procedural objects and hands, in the user's cache folder.

A folder's name has a hash of its content, so that equal models of different data sets share files.
Folders are written under a temporary name and renamed; the oldest ones are removed when there are
too many.
"""

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Final

from handover_marl.assets.hand_model import HANDS_FOLDER, Side, format_hand_urdf, scale_hand
from handover_marl.assets.object_models import (
    COLLISION_NAME,
    OBJECTS_ROOT,
    TEMPLATES_PACKAGE,
    URDF_NAME,
    VISUAL_NAME,
    format_object_urdf,
)
from handover_marl.datasets.generated.hands import Person
from handover_marl.datasets.generated.objects import ProceduralObject
from handover_marl.datasets.generated.shapes import make_surface
from handover_marl.errors import DataNotFoundError
from handover_marl.geometry.array_cache import get_cache_folder
from handover_marl.geometry.model_files.obj_files import format_obj

#: Largest number of folders of models; of more, the oldest ones are removed.
MAX_FOLDERS: Final = 20_000
# Folders that were written within this time (s) are kept: simulations may be about to load them.
_KEPT_TIME = 86_400.0
_CHECK_INTERVAL = 1000
_HAND_NAME = "mano.urdf"
_PALETTE_FILES = ("palette.png", "palette.mtl")

_n_written = 0


def write_object_model(name: str, item: ProceduralObject) -> Path:
    """Write the model of an object unless it exists, and return the path of its URDF.

    Args:
        name: Class name, also the name of the folder.
        item: Object.

    Raises:
        DataNotFoundError: The user's cache folder cannot be written.
    """

    def write(folder: Path) -> None:
        (folder / COLLISION_NAME).write_text(_format_collision(item), newline="\n")
        (folder / VISUAL_NAME).write_text(_format_visual(item), newline="\n")
        (folder / URDF_NAME).write_text(_object_urdf(), newline="\n")
        for file in _PALETTE_FILES:
            shutil.copyfile(_find_palette_folder() / file, folder / file)

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


def _format_collision(item: ProceduralObject) -> str:
    """Return an OBJ text with one convex object for each part."""
    texts, first = [], 1
    for number, part in enumerate(item.parts):
        surface = make_surface(part)
        texts.append(f"o convex_{number}\n{format_obj(surface.vertices, surface.faces, first)}")
        first += len(surface.vertices)
    return "".join(texts)


def _format_visual(item: ProceduralObject) -> str:
    """Return an OBJ text whose faces have the texture coordinates of a color's cell in the palette."""
    names = _list_colors()
    lines = ["mtllib palette.mtl", "o visual", "usemtl palette"]
    lines += [f"vt {(index + 0.5) / len(names):.4f} 0.5" for index in range(len(names))]
    first = 1
    for part in item.parts:
        surface, texture = make_surface(part), names.index(part.color) + 1
        lines += _format_vertices(surface.vertices.tolist())
        lines += [f"f {a}/{texture} {b}/{texture} {c}/{texture}" for a, b, c in (surface.faces + first).tolist()]
        first += len(surface.vertices)
    return "\n".join(lines) + "\n"


def _format_vertices(vertices: Iterable[Iterable[float]]) -> list[str]:
    return [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]


@lru_cache(maxsize=1)
def _list_colors() -> tuple[str, ...]:
    """Return the names of the colors in the order of the palette's cells."""
    return tuple(sorted(json.loads((files(TEMPLATES_PACKAGE) / "palette.json").read_text())))


@lru_cache(maxsize=1)
def _object_urdf() -> str:
    return format_object_urdf()


def _find_palette_folder() -> Path:
    """Return the folder of a shipped object; all have the same palette."""
    return OBJECTS_ROOT / "025_mug"
