"""Files in HandoverSim's folder `assets/`: hands from MANO, the table, and third-party files or stand-ins for them.

The archive of HandoverSim's authors has meshes of the objects and of the Panda, and robot grasps.
Stand-ins are made for users who only have DexYCB's own object models: convex parts by CoACD (Wei et
al., SIGGRAPH 2022), the library's grasps, which were made for objects of the same dimensions, and
PyBullet's Panda. Stand-in files and all results made with them are marked as such.
"""

import functools
import io
import math
import tarfile
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import CAMERA_PANDA_URDF, PANDA_URDF, find_bullet_data, load_object_grasps
from handover_marl.datasets.dexycb.mano import N_JOINTS, PARENTS, ManoModel
from handover_marl.datasets.official import (
    PANDA_FILES,
    STAND_IN,
    FileOrigin,
    classify_file_origin,
    is_stand_in_file,
    read_third_party_checksums,
)
from handover_marl.errors import DataFormatError, ResultsError
from handover_marl.execution.files import (
    create_exclusively,
    has_content,
    remove_stale_temporaries,
    render_template,
    write_atomically,
)
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.execution.reading import check_plain_file, report_damage
from handover_marl.geometry.model_files.meshes import compute_convex_hull, decompose_convex
from handover_marl.geometry.model_files.obj_files import format_convex_parts, format_obj, read_obj
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]

_PALM_MASS, _FINGER_MASS = 0.2, 0.02  # kg
_MAX_ANGLES = (math.pi, math.pi / 2, math.pi)


def format_numbers(*numbers: float) -> str:
    """Return numbers as the text of a URDF attribute: without decimals if all are integers, else with 64 decimals."""
    pattern = "%.0f" if all(float(number).is_integer() for number in numbers) else "%.64f"
    return " ".join(pattern % float(number) for number in numbers)


# Smallest skinning weight of the vertices of a link. The collision meshes at the roots of the
# middle, little and ring finger are smaller, so that neighboring fingers do not touch.
_MIN_WEIGHT, _MIN_ROOT_WEIGHT = 0.2, 0.7
_ROOT_JOINTS = (4, 7, 10)

# Text in PyBullet's table.urdf, its replacement and the number of times it occurs: position and
# size of the table top (visual and collision), then size and positions of the legs, in m.
_TABLE_REPLACEMENTS = (
    ("0 0 0.6", "0 0 0.9", 2),
    ("1.5 1 0.05", "1.77 0.73 0.04", 2),
    ("0.1 0.1 0.58", "0.1 0.1 0.88", 4),
    ('"-0.65 -0.4 0.29"', '"-0.785 -0.265 0.44"', 1),
    ('"-0.65 0.4 0.29"', '"-0.785 0.265 0.44"', 1),
    ('"0.65 -0.4 0.29"', '"0.785 -0.265 0.44"', 1),
    ('"0.65 0.4 0.29"', '"0.785 0.265 0.44"', 1),
)
_COPIED_TABLE_FILES = ("table.obj", "table.mtl", "table.png")


def write_missing_files(folder: Path, files: Mapping[str, bytes], replace_stand_ins: bool = False) -> None:
    """Write those of `files`, contents by path relative to `folder`, that do not exist yet.

    A file with other content raises `ResultsError`; with `replace_stand_ins`, a stand-in is replaced instead.
    """
    for parent in {(folder / name).parent for name in files}:
        remove_stale_temporaries(parent)
    for name, content in files.items():
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ResultsError(f"cannot make the folder {path.parent} ({error.strerror or error})") from error
        if replace_stand_ins and is_stand_in_file(path):
            write_atomically(path, content)
        create_exclusively(path, content)
        if not has_content(path, content):
            raise ResultsError(
                f"{path} exists with other content, perhaps made from other data. It was left as it is; remove it, or "
                "give another folder."
            )


def write_hand_assets(assets: Path, subject: str, model: ManoModel, betas: Sequence[float] | Array) -> Path:
    """Write the 33 files of a subject's hand to `<subject>_<side>/` in `assets/`, and return the path of this folder.

    The files are `mano.urdf` and `meshes/<visual or collision>/mesh1..16.obj`. `betas` (10,) are MANO's shape
    parameters; HandoverSim uses those of the subject's first scene for both hands.
    """
    vertices = model.shape_vertices(betas)
    joints = model.regress_joints(vertices)
    positions = [joints[0], *(joints[joint] - joints[PARENTS[joint]] for joint in range(1, N_JOINTS))]
    # 53 links, 16 with meshes.
    urdf = render_template(
        __package__,
        "hand.urdf",
        positions=[format_numbers(*position) for position in positions],
        parents=PARENTS,
        palm_mass=format_numbers(_PALM_MASS),
        finger_mass=format_numbers(_FINGER_MASS),
        limits=[(format_numbers(-angle), format_numbers(angle)) for angle in _MAX_ANGLES],
    )
    files = {"mano.urdf": urdf.encode()}
    for kind in ("visual", "collision"):
        for joint in range(N_JOINTS):
            weight = _MIN_ROOT_WEIGHT if kind == "collision" and joint in _ROOT_JOINTS else _MIN_WEIGHT
            kept = model.weights[:, joint] > weight
            faces = (np.cumsum(kept) - 1)[model.faces[kept[model.faces].all(axis=1)]]
            files[f"meshes/{kind}/mesh{joint + 1}.obj"] = format_obj(vertices[kept] - joints[joint], faces).encode()
    folder = assets / f"{subject}_{model.side}"
    write_missing_files(folder, files)
    return folder


def write_object_assets(assets: Path) -> None:
    """Write `<class>/model_normalized.urdf` of the 21 YCB classes to the folder `assets`."""
    content = render_template(__package__, "object.urdf").encode()
    write_missing_files(assets, {f"{name}/model_normalized.urdf": content for name in CLASS_NAMES.values()})


def find_table_folder() -> Path:
    """Return the folder of PyBullet's table; raise `OptionError` if PyBullet is not installed."""
    advice = "import with Python 3.11 to 3.13: the folder then serves every Python"
    return find_bullet_data("HandoverSim's table, which is made of PyBullet's,", advice) / "table"


def write_table_assets(assets: Path) -> None:
    """Write the folder `table/` in `assets`: PyBullet's mesh and texture, and a URDF of HandoverSim's table size."""
    source = find_table_folder()
    text = (source / "table.urdf").read_bytes().decode()
    for old, new, times in _TABLE_REPLACEMENTS:
        if text.count(old) != times:
            raise DataFormatError(
                f"table/table.urdf in pybullet_data has {old} {text.count(old)} times instead of {times}; "
                "install the PyBullet that this library asks for again"
            )
        text = text.replace(old, new)
    copies = {name: (source / name).read_bytes() for name in _COPIED_TABLE_FILES}
    write_missing_files(assets / "table", {"table.urdf": text.encode(), **copies})


#: File name of HandoverSim's archive of third-party files.
ARCHIVE_NAME: Final = "assets-3rd-party-20220511.tar.gz"
_ARCHIVE_ADVICE = f"give {ARCHIVE_NAME} of HandoverSim's authors, or the folder that it was unpacked into"

_VISUAL_FILES = ("textured_simple.obj", "textured_simple.obj.mtl", "texture_map.png")
_COLLISION_FILE = "model_normalized_convex.obj"
_PANDA_MESH_FOLDER = "stand_in"


@contextmanager
def open_folder(source: Path) -> Iterator[Path]:
    """Yield `source` if it is a folder, else a temporary folder with the content of the tar archive `source`."""
    with tempfile.TemporaryDirectory() as folder:
        if not source.is_dir():
            with report_damage(source, "tar archive", _ARCHIVE_ADVICE):
                check_plain_file(source)
                with tarfile.open(source) as archive:
                    archive.extractall(folder, filter="data")
        yield source if source.is_dir() else Path(folder)


def install_third_party(source: Path, assets: Path) -> list[str]:
    """Install third-party files in `assets` from HandoverSim's archive, or from the folder that it was unpacked into.

    The folder tree of the files may be at any depth of `source`, but must occur exactly once; else `DataFormatError` is
    raised and nothing is written. Returns a list of at most one warning, about files with unknown checksums.
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
    """Map those of `paths`, relative to `source`, that are third-party files to their paths in `assets/`."""
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


def write_stand_ins(dexycb_models: Path, assets: Path, workers: int, progress: bool) -> list[str]:
    """Complete `assets` with meshes of `dexycb_models` and stand-ins, if that folder exists; return error messages."""
    if not dexycb_models.is_dir():
        return []
    for name in CLASS_NAMES.values():
        for path in (f"{name}/{file}" for file in _VISUAL_FILES):
            if (dexycb_models / path).exists() and not (assets / path).exists():
                write_missing_files(assets, {path: (dexycb_models / path).read_bytes()})
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
    """Cut an object class's mesh into convex parts by CoACD and write them as OBJ; return an error message or ""."""
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
