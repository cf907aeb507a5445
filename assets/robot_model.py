"""The robot: the Panda of PyBullet's data, as it is or with a camera on its hand.

`data/panda` is that folder unchanged, under its Apache licence (`data/panda/LICENSE.txt`), so that it is there, and the
same, where PyBullet is not.
"""

import functools
import os
import shutil
import tempfile
import xml.etree.ElementTree as ET
from multiprocessing import util
from pathlib import Path
from typing import Final

from handover_marl.models.panda import CAMERA_LINK, HAND_FROM_CAMERA_LINK_URDF, HAND_LINK

#: Seven arm joints, two fingers; its links are numbered otherwise than HandoverSim's but named alike.
PANDA_URDF: Final = Path(__file__).resolve().parent / "data" / "panda" / "panda.urdf"

# A housing of the size of a RealSense D435 (m) in the camera's link, where x is left in the picture, y back, z up. It
# lies behind the lens, so that the camera does not see it.
_HOUSING, _HOUSING_ORIGIN = "0.09 0.025 0.025", "0 0.0125 0"
_MASS = 0.01  # kg, as HandoverSim's


def camera_panda_urdf() -> Path:
    """PyBullet's Panda with a camera at HandoverSim's place on the hand.

    Written anew by every process into a folder of its own, since the meshes are named by where the library is.
    """
    path = _written(os.getpid())
    if not path.exists():
        # Temporary folders are tidied up by others, too.
        _written.cache_clear()
        path = _written(os.getpid())
    return path


def panda_text(meshes: str, camera: bool) -> str:
    """PyBullet's Panda as URDF.

    Args:
        meshes: What takes the place of "package:/" in the names of its meshes.
        camera: Whether it has a camera at HandoverSim's place on the hand.
    """
    robot = ET.parse(PANDA_URDF).getroot()
    for mesh in robot.iter("mesh"):
        mesh.set("filename", f"{meshes}/{mesh.attrib['filename'].removeprefix('package://')}")
    if camera:
        robot.append(_camera_link())
        robot.append(_camera_joint())
    return ET.tostring(robot, encoding="unicode")


@functools.cache
def _written(process: int) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="handover_marl_"))
    # Also at the end of worker processes, and never in a child of the process that made it.
    util.Finalize(None, shutil.rmtree, (folder,), {"ignore_errors": True}, exitpriority=0)
    path = folder / "panda_camera.urdf"
    path.write_text(panda_text(str(PANDA_URDF.parent), camera=True))
    return path


def _camera_link() -> ET.Element:
    link = ET.Element("link", name=CAMERA_LINK)
    for purpose in ("visual", "collision"):
        shape = ET.SubElement(link, purpose)
        ET.SubElement(shape, "origin", xyz=_HOUSING_ORIGIN, rpy="0 0 0")
        ET.SubElement(ET.SubElement(shape, "geometry"), "box", size=_HOUSING)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(_MASS))
    ET.SubElement(inertial, "inertia", ixx="1e-5", iyy="1e-5", izz="1e-5", ixy="0", ixz="0", iyz="0")
    return link


def _camera_joint() -> ET.Element:
    xyz, rpy = HAND_FROM_CAMERA_LINK_URDF
    joint = ET.Element("joint", name=f"{CAMERA_LINK}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=HAND_LINK)
    ET.SubElement(joint, "child", link=CAMERA_LINK)
    ET.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    return joint
