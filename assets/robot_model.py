"""URDF files of the Panda, with and without a camera on its hand.

`data/panda` is an unchanged copy of PyBullet's model, under its Apache license (`data/panda/LICENSE.txt`), so that the
robot is the same without PyBullet. `panda_camera.urdf` has in addition a box of the size of a RealSense D435, at the
pose of HandoverSim's camera. The box is behind the lens, so it is not in the camera's images.
"""

from pathlib import Path
from typing import Final

#: Path of the Panda's URDF: seven arm joints, two fingers. Links have the names of HandoverSim's URDF,
#: but other numbers.
PANDA_URDF: Final = Path(__file__).resolve().parent / "data" / "panda" / "panda.urdf"
#: Path of the URDF of the Panda with a camera.
CAMERA_PANDA_URDF: Final = PANDA_URDF.with_name("panda_camera.urdf")
