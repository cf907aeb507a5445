"""Where the models are that PyBullet installs: plain files, for which no physics engine is started."""

from pathlib import Path

import pybullet_data


def bullet_files() -> Path:
    """PyBullet's data folder."""
    return Path(pybullet_data.getDataPath())
