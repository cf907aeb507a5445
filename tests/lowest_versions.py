"""Print the lowest versions of the required packages that setup.cfg allows, as requirements for pip.

python -m tests.lowest_versions
"""

import configparser
from pathlib import Path


def requirements() -> list[str]:
    """Return every requirement, pinned to its lower bound."""
    setup = configparser.ConfigParser()
    setup.read(Path(__file__).parents[1] / "setup.cfg")
    lines = setup["options"]["install_requires"].splitlines()
    return [line.strip().replace(">=", "==", 1) for line in lines if line.strip() and not line.strip().startswith("#")]


if __name__ == "__main__":
    print("\n".join(requirements()))
