"""Where the models are that PyBullet installs: plain files, for which no physics engine is started."""

from pathlib import Path

from handover_marl.options import check_pybullet


def bullet_files(what: str, instead: str) -> Path:
    """PyBullet's data folder.

    Args:
        what: What needs a file of it, for who does not have it.
        instead: What to do then.

    Raises:
        OptionError: PyBullet is not installed.
    """
    check_pybullet(what, instead)
    import pybullet_data

    return Path(pybullet_data.getDataPath())
