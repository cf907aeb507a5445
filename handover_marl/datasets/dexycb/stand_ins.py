"""HandoverSim's third-party files: installation from the archive, or stand-ins for them.

The archive of HandoverSim's authors has meshes of the objects and of the Panda, and robot grasps.
Stand-ins are made for users who only have DexYCB's own object models: convex parts by CoACD (Wei et
al., SIGGRAPH 2022), the library's grasps, which were made for objects of the same dimensions, and
PyBullet's Panda. Stand-in files and all results made with them are marked as such.
"""

import functools
import io
import tarfile
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np

from handover_marl.assets.shipped import CAMERA_PANDA_URDF, PANDA_URDF, load_object_grasps
from handover_marl.datasets.dexycb.assets import write_missing_files
from handover_marl.datasets.official_files import (
    PANDA_FILES,
    STAND_IN,
    FileOrigin,
    classify_file_origin,
    read_third_party_checksums,
)
from handover_marl.errors import DataFormatError
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.execution.reading import check_plain_file, report_damage
from handover_marl.geometry.model_files.meshes import compute_convex_hull, decompose_convex
from handover_marl.geometry.model_files.obj_files import format_convex_parts, read_obj
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.geometry.ycb import CLASS_NAMES

#: File name of HandoverSim's archive of third-party files.
ARCHIVE_NAME: Final = "assets-3rd-party-20220511.tar.gz"
_ARCHIVE_ADVICE = f"give {ARCHIVE_NAME} of HandoverSim's authors, or the folder that it was unpacked into"

_VISUAL_FILES = ("textured_simple.obj", "textured_simple.obj.mtl", "texture_map.png")
_COLLISION_FILE = "model_normalized_convex.obj"
_PANDA_MESH_FOLDER = "stand_in"


@contextmanager
def open_folder(source: Path) -> Iterator[Path]:
    """Yield `source` if it is a folder, else a temporary folder with the content of a tar archive.

    Raises:
        DataNotFoundError: The source does not exist.
        DataFormatError: The file is not a tar archive, is damaged, or contains devices, symbolic links or paths to
            places outside itself.
    """
    with tempfile.TemporaryDirectory() as folder:
        if not source.is_dir():
            with report_damage(source, "tar archive", _ARCHIVE_ADVICE):
                check_plain_file(source)
                with tarfile.open(source) as archive:
                    archive.extractall(folder, filter="data")
        yield source if source.is_dir() else Path(folder)


def install_third_party(source: Path, assets: Path) -> list[str]:
    """Install third-party files from HandoverSim's archive, or the folder that it was unpacked into.

    The files may be at any depth, but must be in one tree; an archive is unpacked and checked before a file is written.
    Returns warnings about files whose content has another checksum than the official one.

    Raises:
        DataNotFoundError, DataFormatError: The source is missing or damaged (`open_folder`), or has none of the files.
        ResultsError: A file exists with other content, or cannot be written.
    """
    unknown = []
    with open_folder(source) as folder:
        paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        targets = _match_paths(source, [path.relative_to(folder) for path in paths])
        for path, target in targets.items():
            content = (folder / path).read_bytes()
            write_missing_files(assets, {target: content}, replace_stand_ins=True)
            is_known = classify_file_origin(target, content) is FileOrigin.ORIGINAL
            if read_third_party_checksums()[target] and not is_known:
                unknown.append(target)
    if not unknown:
        return []
    return [
        f"{len(unknown)} of the {len(targets)} third-party files are not the known ones, such as {min(unknown)}; "
        "results on them say so"
    ]


def _match_paths(source: Path, paths: Iterable[Path]) -> dict[Path, str]:
    """Return, by relative path in the source, the path in `assets/` of every third-party file among these paths."""
    wanted = read_third_party_checksums()
    roots: defaultdict[Path, dict[Path, str]] = defaultdict(dict)
    for path in paths:
        for depth in range(len(path.parts)):
            place = "/".join(path.parts[depth:])
            if place in wanted:
                roots[Path(*path.parts[:depth])][path] = place
    if not roots:
        raise DataFormatError(f"{source} holds none of the files, such as {next(iter(wanted))}; {_ARCHIVE_ADVICE}")
    if len(roots) > 1:
        first, second, *_ = (str(root) for root in roots)
        raise DataFormatError(
            f"{source} holds such files in '{first}' and in '{second}', so that it is not clear which to take; give "
            "the folder with the right ones"
        )
    return next(iter(roots.values()))


def write_stand_ins(models: Path, assets: Path, workers: int, progress: bool) -> list[str]:
    """Write stand-ins for files missing in `assets` if DexYCB's `models` folder exists; return messages on failures.

    Raises:
        ResultsError: A file cannot be written.
    """
    if not models.is_dir():
        return []
    for name in CLASS_NAMES.values():
        for path in (f"{name}/{file}" for file in _VISUAL_FILES):
            if (models / path).exists() and not (assets / path).exists():
                write_missing_files(assets, {path: (models / path).read_bytes()})
        path, grasps = f"grasps/{name}.npy", load_object_grasps(name)
        if grasps is not None and not (assets / path).exists():
            stream = io.BytesIO()
            np.save(stream, np.array({b"source": STAND_IN.encode(), b"transforms": grasps}), allow_pickle=True)
            write_missing_files(assets, {path: stream.getvalue()})
    _write_panda(assets)
    names = [
        name
        for name in CLASS_NAMES.values()
        if (assets / name / _VISUAL_FILES[0]).is_file() and not (assets / name / _COLLISION_FILE).exists()
    ]
    if names and find_spec("coacd") is None:
        return [
            f"{len(names)} objects such as {names[0]} have no convex parts: give HandoverSim's third-party archive "
            "(--third-party), which has the original ones, or install what cuts them (pip install "
            "'handover-marl[import]')"
        ]
    write = functools.partial(_write_convex_parts, assets)
    results = map_with_progress(lambda: write, names, "convex parts", PoolConfig(workers), progress)
    return [fault for _, fault in results if fault]


def _write_convex_parts(assets: Path, name: str) -> str:
    """Write the convex parts of an object's mesh by CoACD, one OBJ object per part; return an error message or ""."""
    model = assets / name / _VISUAL_FILES[0]
    try:
        mesh = read_obj(model)
    except DataFormatError as error:
        return str(error)
    parts = decompose_convex(mesh.vertices, mesh.faces)
    if not parts:
        return f"{model}: CoACD finds no body in it; copy DexYCB's models again"
    text = format_convex_parts((corners, compute_convex_hull(corners)[1]) for corners in parts)
    content = f"# {STAND_IN}: convex parts by CoACD\n{text}".encode()
    write_missing_files(assets, {f"{name}/{_COLLISION_FILE}": content})
    return ""


def _write_panda(assets: Path) -> None:
    """Write PyBullet's Panda, marked as a stand-in, for those variants of the robot that `assets` lacks."""
    missing = [robot for robot, path in PANDA_FILES.items() if not (assets / path).exists()]
    if not missing:
        return
    meshes = {
        f"franka_panda/{_PANDA_MESH_FOLDER}/{file.relative_to(PANDA_URDF.parent).as_posix()}": file.read_bytes()
        for file in sorted((PANDA_URDF.parent / "meshes").rglob("*"))
        if file.is_file()
    }
    write_missing_files(assets, meshes)
    for robot in missing:
        text = (CAMERA_PANDA_URDF if robot == PANDA_CAMERA else PANDA_URDF).read_text()
        robot_element = text[text.index("<robot") :].replace("package://", f"package://{_PANDA_MESH_FOLDER}/")
        content = f"<!-- {STAND_IN}: PyBullet's Panda -->\n{robot_element}".encode()
        write_missing_files(assets, {PANDA_FILES[robot]: content})
