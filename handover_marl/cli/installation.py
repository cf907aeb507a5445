"""Check of the installed packages for the command `handover-marl doctor`."""

import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path

import handover_marl
from handover_marl.datasets.folder_check import Finding, Severity
from handover_marl.simulation.engines import EXACT, list_available_physics

_DISTRIBUTION = "handover-marl"
_REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)[^;]*(?:;.*extra == ['\"]([a-z]+)['\"])?")
_PYTHON_MARKER = re.compile(r"python_version\s*(<|>=)\s*['\"](\d+)\.(\d+)['\"]")
_DEVELOPER_EXTRAS = ("assets", "dev")
_LISTED_PACKAGES = ("numpy", "scipy", "pybullet", "pybullet-arm64", "mujoco", "pettingzoo", "gymnasium")


def examine_installation() -> tuple[Finding, ...]:
    """Check the library, its required packages, the physics engines and the optional extras."""
    machine = f"{platform.system()} {platform.machine()}"
    library = f"handover_marl {handover_marl.__version__}, Python {platform.python_version()}, {machine}"
    findings = [_check_folder(library, Path(handover_marl.__file__).parents[1])]
    try:
        needed = _list_requirements()
    except PackageNotFoundError:
        advice = "the package's metadata is missing; install it with pip"
        return (*findings, Finding("packages", "unknown", Severity.FAULT, advice))
    core = {name: _find_version(name) for name in needed.pop("", [])}
    missing = [name for name, found in core.items() if found is None]
    if missing:
        advice = f"pip install {_DISTRIBUTION} again"
        findings.append(Finding("packages", f"without {', '.join(missing)}", Severity.FAULT, advice))
    else:
        listed = ", ".join(f"{name} {core[name]}" for name in _LISTED_PACKAGES if name in core)
        findings.append(Finding("packages", listed))
    findings.append(_check_physics())
    for extra in sorted(set(needed) - set(_DEVELOPER_EXTRAS)):
        without = [name for name in needed[extra] if _find_version(name) is None]
        if without:
            listed, advice = f"without {', '.join(without)}", f"if you want it: pip install '{_DISTRIBUTION}[{extra}]'"
            findings.append(Finding(f"extra {extra}", listed, Severity.NOTE, advice))
        else:
            findings.append(Finding(f"extra {extra}", "complete"))
    return tuple(findings)


def _list_requirements() -> dict[str, list[str]]:
    """Return the packages of every extra; the key "" is for the required packages.

    Raises:
        PackageNotFoundError: The library is not installed, but runs from a source folder.
    """
    extras = metadata(_DISTRIBUTION).get_all("Provides-Extra", [])
    packages: dict[str, list[str]] = {name: [] for name in ("", *extras)}
    for text in requires(_DISTRIBUTION) or []:
        match = _REQUIREMENT.match(text)
        if match and _applies_to_this_python(text):
            packages[match.group(2) or ""].append(match.group(1))
    return packages


def _applies_to_this_python(requirement: str) -> bool:
    """Return whether a requirement's marker, if any, admits the running Python version."""
    running = sys.version_info[:2]
    versions = [(sign, (int(major), int(minor))) for sign, major, minor in _PYTHON_MARKER.findall(requirement)]
    return all(running < version if sign == "<" else running >= version for sign, version in versions)


def _check_folder(library: str, folder: Path) -> Finding:
    """Check that the folder of the clone, if the library runs from one, does not hide the package."""
    if folder.name != handover_marl.__name__:
        return Finding("library", library)
    advice = (
        f'programs in {folder.parent} import the folder {folder.name} instead of the library and fail with "module '
        f"'{folder.name}' has no attribute ...\"; rename it, for example to {_DISTRIBUTION}, and install it again"
    )
    return Finding("library", library, Severity.NOTE, advice)


def _check_physics() -> Finding:
    available = list_available_physics()
    if EXACT in available:
        return Finding("physics", ", ".join(available))
    advice = "exact and fast need PyBullet, which has wheels up to Python 3.13"
    if available:
        return Finding("physics", ", ".join(available), Severity.NOTE, f"{advice}; use --physics mujoco")
    return Finding("physics", "none", Severity.FAULT, f"pip install {_DISTRIBUTION} again")


def _find_version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
