"""Build the sdist and from it the wheel, check them, and play episodes with the wheel in a clean environment.

    python -m tests.packages              # with this Python, and the lowest versions that setup.cfg allows
    python -m tests.packages --release    # before publishing: with every installed Python, and constraints.txt

A version can be published if CHANGELOG.md has an entry for it, the working tree has no uncommitted changes, and the
version is not tagged yet.
"""

import configparser
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import tyro

from handover_marl import __version__

ROOT = Path(__file__).parents[1]
#: Largest size of a wheel (bytes).
LARGEST = 12_000_000
#: PyBullet has no wheels for Python versions after this one.
LAST_WITH_PYBULLET = (3, 13)
EPISODE = ("benchmark", "--dataset", "synthetic", "--split", "val", "--scenes", "9", "--out", "results", "--fresh")
# The web page that the last line of the output names needs templates, which are data files of the package.
PLAYED, REPORT = "1 of 36 scenes (partial)", "Report: results/report.html"


class PackageError(Exception):
    """A package does not pass a check."""


def read_setup() -> configparser.ConfigParser:
    """Return the content of setup.cfg."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    return setup


def list_supported() -> list[str]:
    """Return the versions of Python, such as "3.11", that setup.cfg lists as supported."""
    return re.findall(r"Python :: (3\.\d+)$", read_setup()["metadata"]["classifiers"], re.MULTILINE)


def list_lowest() -> list[str]:
    """Return the requirements in setup.cfg, pinned to their lower bounds."""
    lines = [line.strip() for line in read_setup()["options"]["install_requires"].splitlines()]
    return [line.replace(">=", "==", 1) for line in lines if line and not line.startswith("#")]


def find_pythons() -> dict[str, str]:
    """Return the program of every supported version of Python on PATH or in pyenv, by version."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = {}
    for version in list_supported():
        candidates = [shutil.which(f"python{version}"), *sorted(kept.glob(f"{version}.*/bin/python{version}"))]
        for program in filter(None, candidates):
            # A program of that name may be a shim of pyenv without a program behind it.
            if subprocess.run([program, "--version"], capture_output=True, check=False).returncode == 0:
                found[version] = str(program)
                break
    return found


def check_publishable(version: str) -> None:
    """Raise a `PackageError` if a version cannot be published."""
    if not re.search(rf"^## {re.escape(version)}$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE):
        raise PackageError(f"CHANGELOG.md has no entry '## {version}'")
    if run("git", "-C", str(ROOT), "status", "--porcelain").strip():
        raise PackageError("there are changes that are not committed; commit or stash them")
    if run("git", "-C", str(ROOT), "tag", "--list", f"v{version}").strip():
        raise PackageError(f"v{version} is tagged already; raise __version__ in handover_marl/version.py")


def build(out: Path) -> Path:
    """Build the packages in the folder `out`, which is replaced, check them, and return the path of the wheel."""
    shutil.rmtree(out, ignore_errors=True)
    run(sys.executable, "-m", "build", "--outdir", str(out), str(ROOT))
    run(sys.executable, "-m", "twine", "check", "--strict", *map(str, out.iterdir()))
    (wheel,) = out.glob("*.whl")
    if wheel.stat().st_size > LARGEST:
        raise PackageError(f"{wheel.name} has {wheel.stat().st_size / 1e6:.1f} MB; at most {LARGEST / 1e6:.0f}")
    strange = [name for name in zipfile.ZipFile(wheel).namelist() if not name.startswith("handover_marl")]
    if strange:
        raise PackageError(f"{wheel.name} holds {strange[0]}, which is not the library's")
    return wheel


def play_with(wheel: Path, version: str, python: str, constraints: Path) -> None:
    """Install a wheel for a version of Python in a clean environment, and play an episode in each kind of physics."""
    place = ROOT / "build" / "smoke"
    run(python, "-m", "venv", "--clear", str(place))
    pip = (str(place / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", "install", "--no-compile")
    run(*pip, "--quiet", "-c", str(constraints), str(wheel))
    number = tuple(map(int, version.split(".")))
    for physics in (["fast"] if number <= LAST_WITH_PYBULLET else []) + (["mujoco"] if number > (3, 10) else []):
        reported = run(str(place / "bin" / "handover-marl"), *EPISODE, "--physics", physics, folder=place)
        if PLAYED not in reported or REPORT not in reported:
            raise PackageError(f"{wheel.name} did not play with {python} in {physics} physics:\n{reported}")
        print(f"{wheel.name}: an episode played with Python {version} in {physics} physics")


def main(release: bool = False) -> None:
    """Build and check the packages, and play episodes with the wheel.

    Args:
        release: Test with every installed Python, and refuse a version that cannot be published.
    """
    if release:
        check_publishable(__version__)
    wheel, constraints = build(ROOT / "dist"), ROOT / "constraints.txt"
    pythons = find_pythons() if release else {".".join(map(str, sys.version_info[:2])): sys.executable}
    if not release:
        constraints = ROOT / "dist" / "lowest.txt"
        constraints.write_text("\n".join(list_lowest()))
    for version, python in pythons.items():
        play_with(wheel, version, python, constraints)
    if release:
        print(f"without a test, since there is no such Python here: {sorted({*list_supported()} - {*pythons})}")


def run(*command: str, folder: Path | None = None) -> str:
    """Run a command and return its output."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise PackageError(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except PackageError as error:
        sys.exit(f"packages: {error}")
