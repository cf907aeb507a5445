"""Paths of the library's object and table models, and of PyBullet's model files.

The objects have the outer dimensions and the frames of the YCB scans that DexYCB and HandoverSim
use, so object poses and grasps of both apply to them. Their shapes are simplified and made by
`python -m handover_marl.assets.building objects`.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from handover_marl.errors import check_name
from handover_marl.execution.options import require_pybullet
from handover_marl.geometry.model_files.urdf import render_urdf
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
#: Package with the templates of URDF files; it is imported without its modules, which need extras.
TEMPLATES_PACKAGE: Final = "handover_marl.assets.building"

#: sRGB values (0 to 255) by color name.
PALETTE: Mapping[str, Sequence[int]] = json.loads((files(TEMPLATES_PACKAGE) / "palette.json").read_text())

#: Path of the table's URDF: HandoverSim's table as boxes, with a top of 1.77 x 0.73 x 0.04 m at a
#: height of 0.92 m and four legs.
TABLE_URDF: Final = DATA_ROOT / "table" / "table.urdf"


def find_object_urdf(name: str) -> Path:
    """Return the path of the URDF of a YCB class, such as "025_mug"; raises `UnknownNameError`."""
    check_name("object", name, CLASS_NAMES.values())
    return OBJECTS_ROOT / name / URDF_NAME


@cache
def format_object_urdf(mass: float = MASS, friction: float = FRICTION) -> str:
    """Return the URDF of an object (mass in kg): six base joints, then a link with the meshes of its folder."""
    names = {"visual": VISUAL_NAME, "collision": COLLISION_NAME}
    return render_urdf(TEMPLATES_PACKAGE, "object.urdf", **names, mass=mass, friction=friction)


def format_visual(colored: Iterable[tuple[str, Array, Faces]]) -> str:
    """Return meshes (color name, vertices in m, faces) as one OBJ text, for a folder with the palette.

    PyBullet draws one texture per OBJ file and ignores vertex colors, so the texture coordinates of every face are
    the center of a color's cell in a small image.
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


def read_palette_files() -> dict[str, bytes]:
    """Return the image and the material file of the colors, which all shipped objects have, by name."""
    return {name: (OBJECTS_ROOT / "025_mug" / name).read_bytes() for name in ("palette.png", "palette.mtl")}


def find_bullet_data(feature: str, advice: str) -> Path:
    """Return PyBullet's folder of model files; errors name the feature that needs it, and what to do instead.

    Raises:
        OptionError: PyBullet is not installed.
    """
    require_pybullet(feature, advice)
    import pybullet_data

    return Path(pybullet_data.getDataPath())
