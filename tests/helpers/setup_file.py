"""Content of setup.cfg, for tests."""

import configparser
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def read_setup() -> configparser.ConfigParser:
    """Return the content of setup.cfg."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    return setup


def list_supported() -> list[str]:
    """Return the versions of Python, such as "3.11", that setup.cfg lists as supported."""
    return re.findall(r"Python :: (3\.\d+)$", read_setup()["metadata"]["classifiers"], re.MULTILINE)
