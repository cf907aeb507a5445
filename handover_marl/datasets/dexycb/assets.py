"""Writers of files in HandoverSim's folder `assets/`: hands from MANO, objects' URDFs and the table."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped import find_bullet_data
from handover_marl.datasets.dexycb.mano import N_JOINTS, PARENTS, ManoModel
from handover_marl.datasets.official_files import is_stand_in_file
from handover_marl.errors import DataFormatError, ResultsError
from handover_marl.execution.files import create_exclusively, has_content, remove_stale_temporaries, write_atomically
from handover_marl.geometry.model_files.obj_files import format_obj
from handover_marl.geometry.model_files.urdf import render_urdf
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]

_PALM_MASS, _FINGER_MASS = 0.2, 0.02  # kg
_MAX_ANGLES = (math.pi, math.pi / 2, math.pi)


def format_numbers(*numbers: float) -> str:
    """Return numbers as the text of a URDF attribute.

    Numbers are written as integers if all of them are integers, otherwise with 64 decimals each.
    """
    pattern = "%.0f" if all(float(number).is_integer() for number in numbers) else "%.64f"
    return " ".join(pattern % float(number) for number in numbers)


# Smallest skinning weight of the vertices of a link. The collision meshes at the roots of the
# middle, little and ring finger are smaller, so that neighbouring fingers do not touch.
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
    """Write files, given as content by path in the folder, if they do not exist; existing ones must be equal.

    With `replace_stand_ins`, existing files that are marked as stand-ins are replaced.

    Raises:
        ResultsError: A file exists with other content, or cannot be written.
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

    The files are `mano.urdf` and `meshes/<visual or collision>/mesh1..16.obj`. HandoverSim uses MANO's shape parameters
    `betas` (10,) of the subject's first scene for both sides.

    Raises:
        ResultsError: A file exists with other content, or cannot be written.
    """
    vertices = model.shape_vertices(betas)
    joints = model.regress_joints(vertices)
    positions = [joints[0], *(joints[joint] - joints[PARENTS[joint]] for joint in range(1, N_JOINTS))]
    # 53 links, 16 with meshes.
    urdf = render_urdf(
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
    """Write `<class>/model_normalized.urdf` of the 21 YCB classes to the folder `assets`.

    Raises:
        ResultsError: A file exists with other content, or cannot be written.
    """
    content = render_urdf(__package__, "object.urdf").encode()
    write_missing_files(assets, {f"{name}/model_normalized.urdf": content for name in CLASS_NAMES.values()})


def find_table_folder() -> Path:
    """Return the folder of PyBullet's table; raise `OptionError` if PyBullet is not installed."""
    advice = "import with Python 3.10 to 3.13: the folder then serves every Python"
    return find_bullet_data("HandoverSim's table, which is made of PyBullet's,", advice) / "table"


def write_table_assets(assets: Path) -> None:
    """Write the folder `table/` in `assets`: HandoverSim's URDF, made from PyBullet's, and PyBullet's mesh and texture.

    Raises:
        OptionError: PyBullet is not installed.
        DataFormatError: PyBullet's table is not the one that HandoverSim uses.
        ResultsError: A file exists with other content, or cannot be written.
    """
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
