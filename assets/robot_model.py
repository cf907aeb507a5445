"""The robot: PyBullet's own Panda, from the data that PyBullet installs."""

from pathlib import Path
from typing import Final

import pybullet_data

#: Seven arm joints, two fingers; its links are numbered otherwise than HandoverSim's but named alike.
PANDA_URDF: Final = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
