"""Tests of the checks of packages before publication.

`make smoke` and `make release` build the packages and play an episode with them.
"""

import sys
import zipfile
from pathlib import Path

import pytest

from handover_marl import __version__
from tests import packages


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


def test_later_pythons_play_in_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[str] = []
    monkeypatch.setattr(packages, "_run", lambda *command, **_: commands.append(command[-1]) or PLAYED)
    for version in ("3.12", "3.14"):
        packages.play_with(tmp_path / "x.whl", version, sys.executable, tmp_path)
    assert commands[1:3] == [f"{tmp_path / 'x.whl'}[mujoco]", "mujoco"]
    assert commands[4:] == commands[1:3]


def test_what_a_failing_command_says_is_reported() -> None:
    with pytest.raises(packages.PackageError, match="failed:\nfor a reason"):
        packages._run(sys.executable, "-c", "import sys; sys.exit('for a reason')")
