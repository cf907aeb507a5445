"""Tests of the packages that setup.cfg requires; `make smoke` and `make release` build the library's own."""

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.helpers.setup_file import ROOT, list_supported, read_setup

#: Packages of physics engines that the library needs, by version of Python.
ENGINES = {
    "3.11": ["pybullet", "mujoco"],
    "3.12": ["pybullet-arm64", "mujoco"],
    "3.13": ["pybullet-arm64", "mujoco"],
    "3.14": ["mujoco"],
}


def list_needed(version: str, requirements: str) -> dict[str, Requirement]:
    """Return the requirements whose markers admit a version of Python, by normalized name."""
    found = [Requirement(line) for line in requirements.splitlines() if line and not line.startswith("#")]
    admitted = [one for one in found if one.marker is None or one.marker.evaluate({"python_version": version})]
    return {canonicalize_name(one.name): one for one in admitted}


@pytest.mark.parametrize("version", list_supported())
def test_every_python_has_physics_and_pinned_packages(version: str) -> None:
    core = list_needed(version, read_setup()["options"]["install_requires"])
    assert [name for name in ("pybullet", "pybullet-arm64", "mujoco") if name in core] == ENGINES[version]
    pins = list_needed(version, (ROOT / "constraints.txt").read_text())
    for name, requirement in core.items():
        (pin,) = pins[name].specifier
        assert pin.operator == "=="
        assert requirement.specifier.contains(pin.version), name
