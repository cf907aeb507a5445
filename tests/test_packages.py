"""Tests of the checks of packages before publication.

`make smoke` and `make release` build the packages and play an episode with them.
"""

import configparser
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from handover_marl import __version__
from tests import packages
from tests.lowest_versions import requirements


def test_this_python_is_supported_and_found() -> None:
    version = ".".join(map(str, sys.version_info[:2]))
    assert version in packages.supported()
    assert version in packages.pythons()


def wheel_of(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name.replace("__", "/"), content)
    return path


def test_wheels_hold_the_library_alone_and_stay_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packages.check_wheel(wheel_of(tmp_path / "good.whl", handover_marl__run=b"x"))
    with pytest.raises(packages.PackageError, match=r"holds tests/run"):
        packages.check_wheel(wheel_of(tmp_path / "more.whl", handover_marl__run=b"x", tests__run=b"x"))
    monkeypatch.setattr(packages, "LARGEST", 10)
    with pytest.raises(packages.PackageError, match="at most"):
        packages.check_wheel(wheel_of(tmp_path / "large.whl", handover_marl__run=b"x"))


@pytest.mark.parametrize(
    ("version", "changes", "tags", "why"),
    [
        ("0.0.1.dev7", "", "", "has no entry"),
        (__version__, " M setup.cfg", "", "not committed"),
        (__version__, "", f"v{__version__}", "tagged already"),
        (__version__, "", "", None),
    ],
)
def test_what_is_not_fit_to_be_published(
    monkeypatch: pytest.MonkeyPatch, version: str, changes: str, tags: str, why: str | None
) -> None:
    monkeypatch.setattr(packages, "_git", lambda command, *_: {"status": changes, "tag": tags}[command])
    if why is None:
        packages.check_final(version)
    else:
        with pytest.raises(packages.PackageError, match=why):
            packages.check_final(version)


def test_a_package_that_cannot_be_installed_or_does_not_play_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[str] = []
    monkeypatch.setattr(packages, "_run", lambda *command, **_: commands.append(command[-1]) or "no table")
    with pytest.raises(packages.PackageError, match="did not play"):
        packages.play_with(tmp_path / "x.whl", "3.11", sys.executable, tmp_path)
    assert commands[1:] == [str(tmp_path / "x.whl"), "fast"]


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


def test_what_a_failing_command_says_is_reported() -> None:
    with pytest.raises(packages.PackageError, match="failed:\nfor a reason"):
        packages._run(sys.executable, "-c", "import sys; sys.exit('for a reason')")
