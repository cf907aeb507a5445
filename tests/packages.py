"""Build the wheel and the sdist, check them, and play an episode with each in a clean environment.

    python -m tests.packages                    # with this Python
    python -m tests.packages --every --final    # with every installed Python that is supported; for publication

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
from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl import __version__
from handover_marl.evaluation.reports.tables import format_table

ROOT = Path(__file__).parents[1]
#: Largest size of a wheel (bytes).
LARGEST = 12_000_000
#: Arguments of the command that plays an episode with an installed package; the name of the physics is appended.
#: PyBullet has no wheels for Python versions after _LAST_WITH_PYBULLET.
EPISODE = (
    *("benchmark", "--dataset", "synthetic", "--split", "val", "--scenes", "9"),
    *("--out", "results", "--fresh", "--physics"),
)
_LAST_WITH_PYBULLET = (3, 13)
# The modules are not compiled, because most modules of the dependencies are never imported.
_PIP_INSTALL = ("-m", "pip", "--disable-pip-version-check", "install", "--no-compile", "--quiet")
_PLAYED, _REPORT = "1 of 36 scenes (partial)", "Report: results/report.html"


@dataclass(frozen=True)
class Args:
    """Options of building and testing packages.

    Attributes:
        every: Test with every supported Python that is found on PATH or in pyenv, instead of only with this one.
        final: Refuse a version that cannot be published.
        out: Folder for the packages.
    """

    every: bool = False
    final: bool = False
    out: str = "dist"


class PackageError(Exception):
    """A package does not pass a check."""


def supported() -> list[str]:
    """Return the versions of Python, such as "3.11", that setup.cfg lists as supported."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    return re.findall(r"Python :: (3\.\d+)$", setup["metadata"]["classifiers"], re.MULTILINE)


def pythons() -> dict[str, str]:
    """Return the program of every supported version of Python that is installed, by version."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = {}
    for version in supported():
        candidates = [shutil.which(f"python{version}"), *sorted(kept.glob(f"{version}.*/bin/python{version}"))]
        # A program of that name may be a shim of pyenv without a program behind it.
        works = (str(program) for program in candidates if program and _runs(str(program), "--version"))
        program = next(works, None)
        if program is not None:
            found[version] = program
    return found


def check_final(version: str) -> None:
    """Check that a version can be published.

    Raises:
        PackageError: The version cannot be published; the message states the reason.
    """
    if not re.search(rf"^## {re.escape(version)}$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE):
        raise PackageError(f"CHANGELOG.md has no entry '## {version}'")
    if _git("status", "--porcelain"):
        raise PackageError("there are changes that are not committed; commit or stash them")
    if _git("tag", "--list", f"v{version}"):
        raise PackageError(f"v{version} is tagged already; raise __version__ in handover_marl/version.py")


def check_wheel(wheel: Path) -> None:
    """Check the size of a wheel, and that it contains only the library.

    Raises:
        PackageError: The wheel is too large, or contains another file.
    """
    size = wheel.stat().st_size
    if size > LARGEST:
        raise PackageError(f"{wheel.name} has {size / 1e6:.1f} MB; at most {LARGEST / 1e6:.0f}")
    strange = [name for name in zipfile.ZipFile(wheel).namelist() if not name.startswith("handover_marl")]
    if strange:
        raise PackageError(f"{wheel.name} holds {strange[0]}, which is not the library's")


def build(out: Path) -> list[Path]:
    """Delete the folder `out`, build the wheel and the sdist in it, and return their paths."""
    shutil.rmtree(out, ignore_errors=True)
    _run(sys.executable, "-m", "build", "--outdir", str(out), str(ROOT))
    packages = [*out.glob("*.whl"), *out.glob("*.tar.gz")]
    _run(sys.executable, "-m", "twine", "check", "--strict", *map(str, packages))
    return packages


def play_with(package: Path, version: str, python: str, place: Path) -> None:
    """Install a package in a clean environment, and play an episode.

    Args:
        package: Wheel or sdist.
        version: Version of Python, such as "3.11".
        python: Program of that Python.
        place: Folder for the environment.

    Raises:
        PackageError: The package cannot be installed, or does not play the episode.
    """
    _run(python, "-m", "venv", "--clear", str(place))
    pip = (str(place / "bin" / "python"), *_PIP_INSTALL)
    _run(*pip, "-c", str(ROOT / "constraints.txt"), str(package))
    physics = "fast" if tuple(map(int, version.split("."))) <= _LAST_WITH_PYBULLET else "mujoco"
    reported = _run(str(place / "bin" / "handover-marl"), *EPISODE, physics, folder=place)
    # The web page that the last line names needs templates, which are data files of the package.
    if _PLAYED not in reported or _REPORT not in reported:
        raise PackageError(f"{package.name} did not play with {python}:\n{reported}")


def main(args: Args) -> str:
    """Build and check the packages, play an episode with each, and return a table of the results.

    Raises:
        PackageError: A package does not pass a check.
    """
    if args.final:
        check_final(__version__)
    packages = build(Path(args.out).absolute())
    for package in packages:
        if package.suffix == ".whl":
            check_wheel(package)
    chosen = pythons() if args.every else {".".join(map(str, sys.version_info[:2])): sys.executable}
    rows = []
    for package in packages:
        for version, program in chosen.items():
            play_with(package, version, program, ROOT / "build" / "smoke")
            rows.append([package.name, f"{package.stat().st_size / 1e6:.1f}", version, "an episode played"])
    missing = sorted(set(supported()) - set(chosen)) if args.every else []
    note = f"\n\nnot tried, for there is no such Python here: {', '.join(missing)}" if missing else ""
    return format_table(["package", "MB", "Python", ""], rows) + note


def _run(*command: str, folder: Path | None = None) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise PackageError(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def _runs(*command: str) -> bool:
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def _git(*arguments: str) -> str:
    return _run("git", "-C", str(ROOT), *arguments).strip()


if __name__ == "__main__":
    try:
        print(main(tyro.cli(Args)))
    except PackageError as error:
        sys.exit(f"packages: {error}")
