"""Tests of the architecture rules: packages, their order, file counts, and where engines may be imported."""

import ast
import re
from collections import Counter, defaultdict
from pathlib import Path

import pytest

from tests.import_graph import (
    FOLDERS,
    REPOSITORY,
    build_import_graph,
    build_package_graph,
    find_modules,
    sort_into_layers,
)

ROOT = REPOSITORY / "handover_marl"
MAX_PACKAGES, MAX_FILES = 12, 20


def strongly_connected(edges: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other in a cycle."""
    reach: dict[str, set[str]] = {}
    for start in edges:
        found: set[str] = set()
        stack = list(edges[start])
        while stack:
            name = stack.pop()
            if name not in found:
                found.add(name)
                stack += edges[name]
        reach[start] = found
    circles = {tuple(sorted(b for b in reach[a] if a in reach[b])) for a in edges if a in reach[a]}
    return [list(circle) for circle in sorted(circles)]


def test_no_modules_import_each_other_in_a_circle() -> None:
    edges = build_import_graph()
    # The library's own __init__ is left out, because it imports modules lazily, by name.
    edges = {name: found - {"handover_marl"} for name, found in edges.items() if name != "handover_marl"}
    assert strongly_connected(edges) == []


def test_no_module_imports_what_stands_above_it() -> None:
    """Layers are those of all imports, in functions, too: no module imports the library itself, or a module by text."""
    edges = build_import_graph()
    assert [name for name, found in edges.items() if "handover_marl" in found] == []
    texts = {name: path.read_text() for name, path in find_modules().items()}
    assert [name for name, text in texts.items() if re.search(r"import_module\(f?.handover_marl", text)] == []


def test_circles_are_found() -> None:
    assert strongly_connected({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_packages_are_in_layers() -> None:
    edges = build_package_graph()
    assert sorted(name for row in sort_into_layers(edges) for name in row) == sorted(edges)


def test_at_most_twelve_packages() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"assets", "givers", "receivers"}
    assert len(packages) <= MAX_PACKAGES, sorted(packages)


def test_few_files_at_the_root() -> None:
    files = {path.name for path in ROOT.glob("*.py")}
    assert files <= {"__init__.py", "config.py", "errors.py", "testing.py", "registration.py", "version.py"}


@pytest.mark.parametrize("top", [*FOLDERS.values(), REPOSITORY / "experiments"], ids=lambda path: path.name)
def test_few_files_in_a_folder(top: Path) -> None:
    counts = Counter(path.parent for path in top.rglob("*.py"))
    assert {str(folder): count for folder, count in counts.items() if count > MAX_FILES} == {}


def users_of(package: str) -> set[str]:
    pattern = re.compile(rf"^\s*(import|from) {package}\b", re.MULTILINE)
    return {name.rpartition(".")[0] for name, path in find_modules().items() if pattern.search(path.read_text())}


@pytest.mark.parametrize(
    ("engine", "packages"),
    [
        ("pybullet", {"simulation.bullet"}),
        ("mujoco", {f"simulation.mujoco{name}" for name in ("", ".batches", ".models")}),
        ("mujoco_warp", {"simulation.mujoco.batches"}),
        ("warp", {"simulation", "simulation.camera", "simulation.mujoco.batches"}),
    ],
)
def test_only_some_packages_import_an_engine(engine: str, packages: set[str]) -> None:
    assert users_of(engine) == {f"handover_marl.{package}" for package in packages}


def test_a_class_name_means_one_thing() -> None:
    homes = defaultdict(list)
    for name, path in find_modules().items():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_") and node.name != "Args":
                homes[node.name].append(name)
    assert {name: places for name, places in homes.items() if len(places) > 1} == {}


def test_test_folders_mirror_packages() -> None:
    folders = {path.parent.relative_to(REPOSITORY / "tests") for path in (REPOSITORY / "tests").rglob("test_*.py")}
    packages = {name.removeprefix("handover_marl").removeprefix(".").replace(".", "/") for name in find_modules()}
    others = {"", ".", "docs", "integration", "experiments"}
    assert {folder.as_posix() for folder in folders} <= packages | others
