"""What users install: wheel and sdist, looked at, and an episode played with each in a clean environment.

    python -m tests.packages                    # with this Python
    python -m tests.packages --every --final    # with every supported Python at hand, and fit to be published

A package that is fit to be published has a version with an entry of its own in CHANGELOG.md, comes from a tree without
uncommitted changes, and is not tagged yet.
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
#: A wheel is at most so large (bytes).
LARGEST = 12_000_000
#: What is played with an installed package, and in which physics; PyBullet has no wheels for later Pythons.
EPISODE = (
    *("benchmark", "--dataset", "synthetic", "--split", "val", "--scenes", "9"),
    *("--out", "results", "--fresh", "--physics"),
)
_LAST_WITH_PYBULLET = (3, 11)
# Without compiling: most modules of the dependencies are never imported.
_PIP_INSTALL = ("-m", "pip", "--disable-pip-version-check", "install", "--no-compile", "--quiet")
_PLAYED, _REPORT = "1 of 36 scenes (partial)", "Report: results/report.html"


@dataclass(frozen=True)
class Args:
    """What is built and tried.

    Attributes:
        every: With every supported Python that is found on PATH or in pyenv, not with this one alone.
        final: Refuse what is not fit to be published.
        out: Where the packages go.
    """

    every: bool = False
    final: bool = False
    out: str = "dist"


class PackageError(Exception):
    """A package is not as it should be."""


def supported() -> list[str]:
    """Versions of Python, such as "3.11", that setup.cfg claims."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    return re.findall(r"Python :: (3\.\d+)$", setup["metadata"]["classifiers"], re.MULTILINE)


def pythons() -> dict[str, str]:
    """The supported ones at hand: version to program."""
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = {}
    for version in supported():
        candidates = [shutil.which(f"python{version}"), *sorted(kept.glob(f"{version}.*/bin/python{version}"))]
        # A program of that name may be a shim that leads nowhere.
        works = (str(program) for program in candidates if program and _runs(str(program), "--version"))
        program = next(works, None)
        if program is not None:
            found[version] = program
    return found


def check_final(version: str) -> None:
    """Whether a version may be published.

    Raises:
        PackageError: It may not, and why.
    """
    if not re.search(rf"^## {re.escape(version)}$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE):
        raise PackageError(f"CHANGELOG.md has no entry '## {version}'")
    if _git("status", "--porcelain"):
        raise PackageError("there are changes that are not committed; commit or stash them")
    if _git("tag", "--list", f"v{version}"):
        raise PackageError(f"v{version} is tagged already; raise __version__ in handover_marl/__init__.py")


def check_wheel(wheel: Path) -> None:
    """Its size, and that nothing is in it that is not the library.

    Raises:
        PackageError: It is too large, or holds something else.
    """
    size = wheel.stat().st_size
    if size > LARGEST:
        raise PackageError(f"{wheel.name} has {size / 1e6:.1f} MB; at most {LARGEST / 1e6:.0f}")
    strange = [name for name in zipfile.ZipFile(wheel).namelist() if not name.startswith("handover_marl")]
    if strange:
        raise PackageError(f"{wheel.name} holds {strange[0]}, which is not the library's")


def build(out: Path) -> list[Path]:
    """Wheel and sdist, after what lay there is gone."""
    shutil.rmtree(out, ignore_errors=True)
    _run(sys.executable, "-m", "build", "--outdir", str(out), str(ROOT))
    packages = [*out.glob("*.whl"), *out.glob("*.tar.gz")]
    _run(sys.executable, "-m", "twine", "check", "--strict", *map(str, packages))
    return packages


def needed_for(version: str) -> tuple[str, str]:
    """The extra, in pip's brackets, and the physics that are played with a Python such as "3.11"."""
    with_pybullet = tuple(map(int, version.split("."))) <= _LAST_WITH_PYBULLET
    return ("", "fast") if with_pybullet else ("[mujoco]", "mujoco")


def play_with(package: Path, version: str, python: str, place: Path) -> None:
    """Install a package in a clean environment, and play an episode.

    Args:
        package: Wheel or sdist.
        version: Of Python, such as "3.11".
        python: Its program.
        place: Where the environment goes.

    Raises:
        PackageError: It cannot be installed, or does not play.
    """
    _run(python, "-m", "venv", "--clear", str(place))
    pip = (str(place / "bin" / "python"), *_PIP_INSTALL)
    extra, physics = needed_for(version)
    _run(*pip, "-c", str(ROOT / "constraints.txt"), f"{package}{extra}")
    reported = _run(str(place / "bin" / "handover-marl"), *EPISODE, physics, folder=place)
    # The web page, named in the last line, needs templates, which are data files of the package.
    if _PLAYED not in reported or _REPORT not in reported:
        raise PackageError(f"{package.name} did not play with {python}:\n{reported}")


def main(args: Args) -> str:
    """Everything; a table of what was done.

    Raises:
        PackageError: Something is not as it should be.
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
