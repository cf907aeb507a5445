"""What of the library's packages is installed."""

import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, metadata, requires, version

from handover_marl._version import __version__
from handover_marl.doctor.findings import Finding, State
from handover_marl.sim.engines import EXACT, available_physics

_DISTRIBUTION = "handover-marl"
_REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)[^;]*(?:;.*extra == ['\"]([a-z]+)['\"])?")
_PYTHON = re.compile(r"python_version\s*(<|>=)\s*['\"](\d+)\.(\d+)['\"]")
_FOR_DEVELOPERS = ("assets", "dev")
_TOLD = ("numpy", "scipy", "pybullet", "pettingzoo", "gymnasium")


def examine_installation() -> tuple[Finding, ...]:
    """The library, what it needs, and which extras are complete."""
    python = (
        f"handover_marl {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    )
    findings = [Finding("library", python)]
    try:
        needed = _needed()
    except PackageNotFoundError:
        advice = "the package's metadata is not there; install it with pip"
        return (*findings, Finding("packages", "unknown", State.FAULT, advice))
    core = {name: _version(name) for name in needed.pop("", [])}
    lacking = [name for name, found in core.items() if found is None]
    if lacking:
        advice = f"pip install {_DISTRIBUTION} again"
        findings.append(Finding("packages", f"without {', '.join(lacking)}", State.FAULT, advice))
    else:
        told = ", ".join(f"{name} {core[name]}" for name in _TOLD if name in core)
        findings.append(Finding("packages", told))
    findings.append(_physics())
    for extra in sorted(set(needed) - set(_FOR_DEVELOPERS)):
        without = [name for name in needed[extra] if _version(name) is None]
        if without:
            told, advice = f"without {', '.join(without)}", f"if you want it: pip install '{_DISTRIBUTION}[{extra}]'"
            findings.append(Finding(f"extra {extra}", told, State.NOTE, advice))
        else:
            findings.append(Finding(f"extra {extra}", "complete"))
    return tuple(findings)


def _needed() -> dict[str, list[str]]:
    """Extra, or nothing for the core -> packages.

    Raises:
        PackageNotFoundError: The library runs from a folder without being installed.
    """
    packages: dict[str, list[str]] = {
        "": [],
        **{name: [] for name in metadata(_DISTRIBUTION).get_all("Provides-Extra", [])},
    }
    for text in requires(_DISTRIBUTION) or []:
        match = _REQUIREMENT.match(text)
        if match and _for_this_python(text):
            packages[match.group(2) or ""].append(match.group(1))
    return packages


def _for_this_python(requirement: str) -> bool:
    """Whether a requirement's marker, if it has one, lets it count for the Python that runs."""
    here = sys.version_info[:2]
    versions = [(sign, (int(major), int(minor))) for sign, major, minor in _PYTHON.findall(requirement)]
    return all(here < version if sign == "<" else here >= version for sign, version in versions)


def _physics() -> Finding:
    """What can be played."""
    there = available_physics()
    if EXACT in there:
        return Finding("physics", ", ".join(there))
    advice = "exact and fast need PyBullet, which has wheels up to Python 3.11"
    if there:
        return Finding("physics", ", ".join(there), State.NOTE, f"{advice}; say physics='mujoco' (--physics mujoco)")
    return Finding("physics", "none", State.FAULT, f"{advice}; pip install '{_DISTRIBUTION}[mujoco]'")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
