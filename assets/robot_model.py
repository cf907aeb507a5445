"""URDF of the Panda, with or without a camera on its hand.

`data/panda` is an unchanged copy of PyBullet's model, under its Apache license
(`data/panda/LICENSE.txt`), so that the robot is the same without PyBullet.
"""

import functools
import os
import shutil
import tempfile
import xml.etree.ElementTree as ET
from multiprocessing import util
from pathlib import Path
from typing import Final

from handover_marl.geometry.panda import CAMERA_LINK, HAND_FROM_CAMERA_LINK_URDF, HAND_LINK

#: Path of the Panda's URDF: seven arm joints, two fingers. Links have the names of HandoverSim's URDF,
#: but other numbers.
PANDA_URDF: Final = Path(__file__).resolve().parent / "data" / "panda" / "panda.urdf"

# Box (m) of the size of a RealSense D435 in the camera link, where x points left in the image, y
# back and z up. It is behind the lens, so it is not in the camera's images.
_HOUSING_SIZE, _HOUSING_ORIGIN = "0.09 0.025 0.025", "0 0.0125 0"
_MASS = 0.01  # kg, as in HandoverSim


def write_camera_panda_urdf() -> Path:
    """Write the URDF of the Panda with a camera to a temporary folder and return its path.

    Every process writes its own file, since the URDF has absolute paths of meshes.
    """
    path = _write_camera_panda(os.getpid())
    if not path.exists():
        # Other programs may clean up temporary folders.
        _write_camera_panda.cache_clear()
        path = _write_camera_panda(os.getpid())
    return path


def format_panda_urdf(meshes: str, camera: bool) -> str:
    """Return the text of the Panda's URDF.

    Args:
        meshes: Replacement of "package:/" in the file names of the meshes.
        camera: Whether to add a camera to the hand, at the pose of HandoverSim's camera.
    """
    robot = ET.parse(PANDA_URDF).getroot()
    for mesh in robot.iter("mesh"):
        mesh.set("filename", f"{meshes}/{mesh.attrib['filename'].removeprefix('package://')}")
    if camera:
        robot.extend(_make_camera())
    return ET.tostring(robot, encoding="unicode")


@functools.cache
def _write_camera_panda(process: int) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="handover_marl_"))
    # Unlike atexit, also runs at the end of worker processes, and not in forked children.
    util.Finalize(None, shutil.rmtree, (folder,), {"ignore_errors": True}, exitpriority=0)
    path = folder / "panda_camera.urdf"
    path.write_text(format_panda_urdf(str(PANDA_URDF.parent), camera=True))
    return path


def _make_camera() -> list[ET.Element]:
    """Return the camera's link, and its joint to the hand."""
    xyz, rpy = HAND_FROM_CAMERA_LINK_URDF
    shape = f'<origin xyz="{_HOUSING_ORIGIN}" rpy="0 0 0"/><geometry><box size="{_HOUSING_SIZE}"/></geometry>'
    return list(
        ET.fromstring(
            f'<robot><link name="{CAMERA_LINK}"><visual>{shape}</visual><collision>{shape}</collision>'
            f'<inertial><mass value="{_MASS}"/>'
            '<inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{CAMERA_LINK}_joint" type="fixed"><parent link="{HAND_LINK}"/>'
            f'<child link="{CAMERA_LINK}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint></robot>'
        )
    )
