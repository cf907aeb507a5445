"""Models, robot grasps, grasp validations and network weights that are part of the library.

The shapes of the objects are simplified. Their outer dimensions and frames are those of the YCB scans in DexYCB and
HandoverSim, so object poses and grasps of both apply to them.

Gripper poses follow the convention of HandoverSim's grasp files: the fingers close along x, the hand approaches along
z, and the Panda's hand link is the gripper frame rotated by -90 degrees about z.
"""

import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from handover_marl.errors import check_name
from handover_marl.execution.files import render_template
from handover_marl.execution.options import require_pybullet
from handover_marl.execution.reading import read_arrays, report_damage
from handover_marl.geometry.model_files.obj_files import format_convex_parts
from handover_marl.geometry.ycb import CLASS_NAMES

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]

DATA_ROOT = Path(__file__).resolve().parent / "data"
OBJECTS_ROOT = DATA_ROOT / "objects"
#: File names in an object's folder, as in HandoverSim.
URDF_NAME = "model_normalized.urdf"
VISUAL_NAME, COLLISION_NAME = "textured_simple.obj", "model_normalized_convex.obj"

#: Mass (kg) and lateral friction of all objects in HandoverSim.
MASS, FRICTION = 0.5, 0.9
#: Package with the templates of URDF files. Importing it does not import its modules, which need extras.
TEMPLATES_PACKAGE: Final = "handover_marl.assets.building"

#: sRGB values (0 to 255) by color name.
PALETTE: Mapping[str, Sequence[int]] = json.loads((files(TEMPLATES_PACKAGE) / "palette.json").read_text())

#: Paths of the Panda's URDFs, without and with a camera on its hand. Links have the names of HandoverSim's URDF, but
#: other indices. `data/panda` is an unchanged copy of PyBullet's model, under its Apache license, so that the robot is
#: the same without PyBullet. `panda_camera.urdf` has in addition a box of the size of a RealSense D435, at the pose of
#: HandoverSim's camera. The box is behind the lens, so it is not in the camera's images.
PANDA_URDF: Final = DATA_ROOT / "panda" / "panda.urdf"
CAMERA_PANDA_URDF: Final = PANDA_URDF.with_name("panda_camera.urdf")

#: Path of the table's URDF: HandoverSim's table as boxes, with a top of 1.77 x 0.73 x 0.04 m at a
#: height of 0.92 m and four legs.
TABLE_URDF: Final = DATA_ROOT / "table" / "table.urdf"

#: Path of the robot grasps, made and validated in simulation by `building/grasps.py`.
GRASPS_PATH = DATA_ROOT / "grasps.npz"
#: YCB classes that are wider than the gripper opens; neither the library nor HandoverSim has grasps.
CLASSES_WITHOUT_GRASPS = ("002_master_chef_can", "036_wood_block")

#: Path of the grasp validations, made by `building/grasps.py`.
VALIDATION_PATH = DATA_ROOT / "grasp_validations.npz"
#: Results of the validation in simulation of an object's n grasps, (n, 4): first known grasps, then tilted copies.
#: Columns: index of the copy, -1 for a known grasp; number of poses at and near the grasp that held the object when
#: shaken; number (from 1) of the distance in `GraspPreparationConfig.advances` by which the grasp was moved towards the
#: object, 0 for none; number of poses at and near the moved grasp that kept the object when the person released it.
ValidationRecord = npt.NDArray[np.int16]

#: Path of the weights of the receiver `gaddpg`. `experiments/training/train_gaddpg.py` trained them on
#: the scenes that each of the setups s0 to s3 has in its training split.
GADDPG_WEIGHTS = DATA_ROOT / "gaddpg.npz"


def find_object_urdf(name: str) -> Path:
    """Return the path of the URDF of a YCB class, such as "025_mug"; raise `UnknownNameError` for other names."""
    check_name("object", name, CLASS_NAMES.values())
    return OBJECTS_ROOT / name / URDF_NAME


def format_object_files(
    colored: Iterable[tuple[str, Array, Faces]],
    parts: Iterable[tuple[Array, Faces]],
    mass: float = MASS,
    friction: float = FRICTION,
    center: Sequence[float] | None = None,
) -> dict[str, bytes | str]:
    """Return the contents of an object's files by file name: meshes, palette, and a URDF with HandoverSim's six joints.

    `colored` has the meshes to draw: name in `PALETTE`, vertices (v, 3) in m and faces (f, 3). `parts` has the vertices
    and faces of the convex parts for collisions. The center of mass is at `center` (3,) in m; None is the origin, as
    for YCB objects. `mass` is in kg, `friction` is the coefficient of lateral friction.
    """
    names = {"visual": VISUAL_NAME, "collision": COLLISION_NAME}
    values: Any = {"mass": mass, "friction": friction}
    values["center"] = "" if center is None else " ".join(f"{value:.6f}" for value in center)
    return {
        COLLISION_NAME: format_convex_parts(parts),
        VISUAL_NAME: _format_visual(colored),
        **{name: (OBJECTS_ROOT / "025_mug" / name).read_bytes() for name in ("palette.png", "palette.mtl")},
        URDF_NAME: render_template(TEMPLATES_PACKAGE, "object.urdf", **names, **values),
    }


def _format_visual(colored: Iterable[tuple[str, Array, Faces]]) -> str:
    """Return colored meshes as the text of one OBJ file; for the argument and the palette see `format_object_files`.

    PyBullet draws one texture per OBJ file and ignores vertex colors. Therefore the palette is a small image with a
    cell for each color, and the texture coordinates of a face are the center of its color's cell.
    """
    names = sorted(PALETTE)
    lines = ["mtllib palette.mtl", "o visual", "usemtl palette"]
    lines += [f"vt {(index + 0.5) / len(names):.4f} 0.5" for index in range(len(names))]
    first = 1
    for color, vertices, faces in colored:
        texture = names.index(color) + 1
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
        lines += [f"f {a}/{texture} {b}/{texture} {c}/{texture}" for a, b, c in (faces + first).tolist()]
        first += len(vertices)
    return "\n".join(lines) + "\n"


def find_bullet_data(feature: str, advice: str) -> Path:
    """Return PyBullet's folder of model files; without PyBullet, raise `OptionError` about `feature`, with `advice`."""
    require_pybullet(feature, advice)
    import pybullet_data

    return Path(pybullet_data.getDataPath())


def find_vision_weights(network: str, setup: str) -> Path:
    """Return the path of a network of the receiver `vision` that was trained on the train split of an official setup.

    The network is "vision", which predicts grasps, or "segmentation". The file need not exist.
    """
    return DATA_ROOT / f"{network}_{setup}.npz"


def load_object_grasps(name: str) -> npt.NDArray[np.float64] | None:
    """Load the gripper poses (100, 4, 4) at grasps of a YCB class, in the object's frame (m); None without grasps."""
    check_name("object", name, CLASS_NAMES.values())
    if name in CLASSES_WITHOUT_GRASPS:
        return None
    return np.asarray(load_shipped_arrays(GRASPS_PATH)[name].astype(np.float64))


def load_validation_record(name: str) -> ValidationRecord | None:
    """Return a shipped `ValidationRecord` (n, 4) by its name, `CLASS-HASH`, or None if no record has this name."""
    return load_shipped_arrays(VALIDATION_PATH).get(name)


@functools.cache
def load_shipped_arrays(path: Path) -> Mapping[str, npt.NDArray[Any]]:
    """Load the arrays of a shipped `.npz` file by name; cached. A damaged file raises `DataFormatError`."""
    with report_damage(path, "file of arrays", "install the library again"):
        return MappingProxyType(read_arrays(path))
