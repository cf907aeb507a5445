"""Tests of the packages that setup.cfg requires; `make smoke` and `make release` build the library's own."""

import configparser
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests import packages
from tests.lowest_versions import requirements

PLAYED = f"{packages._PLAYED}\n{packages._REPORT}"


def test_pythons_without_pybullet_play_in_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[str] = []
    monkeypatch.setattr(packages, "_run", lambda *command, **_: commands.append(command[-1]) or PLAYED)
    for version in packages.supported():
        packages.play_with(tmp_path / "x.whl", version, sys.executable, tmp_path)
    played = dict(zip(packages.supported(), commands[2::3], strict=True))
    assert played == {version: "fast" if "pybullet" in ENGINES[version][0] else "mujoco" for version in ENGINES}


#: Packages of physics engines that the library needs, by version of Python.
ENGINES = {
    "3.10": ["pybullet"],
    "3.11": ["pybullet", "mujoco"],
    "3.12": ["pybullet-arm64", "mujoco"],
    "3.13": ["pybullet-arm64", "mujoco"],
    "3.14": ["mujoco"],
}


def needed(version: str, requirements: str) -> dict[str, Requirement]:
    """Return the requirements whose markers admit a version of Python, by normalized name."""
    lines = [line for line in requirements.splitlines() if line and not line.startswith("#")]
    found = [Requirement(line) for line in lines]
    return {
        canonicalize_name(requirement.name): requirement
        for requirement in found
        if requirement.marker is None or requirement.marker.evaluate({"python_version": version})
    }


@pytest.mark.parametrize("version", packages.supported())
def test_every_python_has_physics_and_pinned_packages(version: str) -> None:
    setup = configparser.ConfigParser()
    setup.read(packages.ROOT / "setup.cfg")
    core = needed(version, setup["options"]["install_requires"])
    assert [name for name in ("pybullet", "pybullet-arm64", "mujoco") if name in core] == ENGINES[version]
    pins = needed(version, (packages.ROOT / "constraints.txt").read_text())
    for name, requirement in core.items():
        (pin,) = pins[name].specifier
        assert pin.operator == "=="
        assert requirement.specifier.contains(pin.version), name


def test_the_lowest_versions_are_those_of_setup_cfg() -> None:
    assert "tyro==1.0.14" in requirements()
    assert 'mujoco==4.0,<5; python_version >= "3.11"' in requirements()
