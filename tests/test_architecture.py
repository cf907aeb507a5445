"""Tests of the architecture rules: packages, their order, file counts, and where engines may be imported."""

import ast
import functools
import re
from collections import Counter, defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.docs.pages import REPOSITORY, checked_table

ROOT = REPOSITORY / "handover_marl"
#: Folder of each top-level package of the import tree.
FOLDERS = {"handover_marl": ROOT} | {f"handover_marl.{name}": ROOT / name for name in ("givers", "receivers", "assets")}
#: Subpackages that count apart from their parents, because they import packages that import the parent.
APART = ("learning.imitation", "learning.networks", "learning.training", "assets.building")
MAX_PACKAGES, MAX_FILES = 13, 20


@functools.cache
def find_modules() -> dict[str, Path]:
    """Return the files of all modules of the library by module name."""
    found = {}
    for package, folder in FOLDERS.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return found


def find_imports(path: Path) -> set[str]:
    """Return the modules of the library that a file imports, also in functions and for type checking alone."""
    modules, names = find_modules(), set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
            names |= submodules | ({node.module} if len(submodules) < len(node.names) else set())
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names & modules.keys()


@functools.cache
def build_import_graph() -> dict[str, set[str]]:
    """Return the other modules that each module imports; `handover_marl` itself, which imports by name, is no key."""
    modules = {name: path for name, path in find_modules().items() if name != "handover_marl"}
    return {name: find_imports(path) - {name} for name, path in modules.items()}


def find_package(module: str) -> str | None:
    """Return the package to which a module belongs, by its full name; None for modules at the root."""
    parts = module.split(".")[1:]
    apart = [name for name in APART if parts[:2] == name.split(".")]
    is_package = len(parts) > 1 or find_modules()[module].name == "__init__.py"
    return apart[0] if apart else parts[0] if is_package else None


def test_modules_are_in_layers() -> None:
    modules = build_import_graph()
    TopologicalSorter(modules).prepare()
    with pytest.raises(CycleError):
        TopologicalSorter({**modules, "handover_marl.errors": {"handover_marl.cli"}}).prepare()


def test_the_page_on_architecture_has_the_layers() -> None:
    """Each package imports only packages of lower layers in the table."""
    packages: dict[str | None, set[str | None]] = defaultdict(set)
    for module, imported in build_import_graph().items():
        package = find_package(module)
        packages[package] |= {find_package(name) for name in imported} - {package, None}
    rows = checked_table(REPOSITORY / "docs" / "explanation" / "architecture.md", "packages")
    layers = {name.strip("`"): int(layer) for layer, name, *_ in rows}
    assert layers.keys() == packages.keys() - {None}
    assert [name for name, layer in layers.items() if any(layers[other] >= layer for other in packages[name])] == []


def test_no_module_imports_the_library_itself_or_a_module_by_text() -> None:
    assert [name for name, found in build_import_graph().items() if "handover_marl" in found] == []
    texts = {name: path.read_text() for name, path in find_modules().items()}
    assert [name for name, text in texts.items() if re.search(r"import_module\(f?.handover_marl", text)] == []


def test_packages_and_files_are_few() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"assets", "givers", "receivers"}
    assert len(packages) <= MAX_PACKAGES, sorted(packages)
    files = {path.name for path in ROOT.glob("*.py")}
    assert files <= {"__init__.py", "config.py", "errors.py", "testing.py", "registration.py", "version.py"}
    tops = (*FOLDERS.values(), REPOSITORY / "experiments")
    counts = Counter(path.parent for top in tops for path in top.rglob("*.py"))
    assert {str(folder): count for folder, count in counts.items() if count > MAX_FILES} == {}


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
    pattern = re.compile(rf"^\s*(import|from) {engine}\b", re.MULTILINE)
    users = {name.rpartition(".")[0] for name, path in find_modules().items() if pattern.search(path.read_text())}
    assert users == {f"handover_marl.{package}" for package in packages}
