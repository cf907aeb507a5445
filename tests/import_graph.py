"""Import graph of the library's modules and packages, for the tests of its rules."""

import ast
from collections import defaultdict
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
#: Folder of each top-level package of the import tree.
FOLDERS = {"handover_marl": REPOSITORY / "handover_marl"} | {
    f"handover_marl.{name}": REPOSITORY / "handover_marl" / name for name in ("givers", "receivers", "assets")
}
#: Subpackages that count apart from their parents, because they import packages that import the parent.
DRAWN_APART = ("learning.imitation", "learning.networks", "learning.training", "assets.building")


def find_modules() -> dict[str, Path]:
    """Return the files of all modules of the library by module name."""
    found = {}
    for package, folder in FOLDERS.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return found


def find_imports(path: Path, modules: dict[str, Path]) -> set[str]:
    """Return the modules of the library that a file imports, anywhere in it.

    An import for type checking alone counts; the lazy table of the library's `__init__` does not.
    """
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
            has_others = len(submodules) < len(node.names)
            names |= submodules | ({node.module} if has_others else set())
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names & modules.keys()


def build_import_graph() -> dict[str, set[str]]:
    """Return the library's modules that each module of the library imports, by module name."""
    modules = find_modules()
    return {name: find_imports(path, modules) - {name} for name, path in modules.items()}


def find_package(module: str) -> str | None:
    """Return the package to which a module belongs; None for modules at the root.

    Args:
        module: Full name of the module.
    """
    parts = module.split(".")[1:]
    for apart in DRAWN_APART:
        if parts[:2] == apart.split("."):
            return apart
    is_package = len(parts) > 1 or (parts and find_modules()[module].name == "__init__.py")
    return parts[0] if is_package else None


def build_package_graph() -> dict[str, set[str]]:
    """Return the other packages that each package of the library imports, by package name."""
    edges: dict[str, set[str]] = defaultdict(set)
    packages = {module: find_package(module) for module in find_modules()}
    for module, imported in build_import_graph().items():
        package = packages[module]
        if package is not None:
            edges[package] |= {other for name in imported if (other := packages[name]) not in (None, package)}
    return dict(edges)


def sort_into_layers(edges: dict[str, set[str]]) -> list[list[str]]:
    """Sort packages into layers, lowest first; packages in import cycles are left out.

    Args:
        edges: Packages that each package imports, by package name.
    """
    placed: list[list[str]] = []
    below: set[str] = set()
    while True:
        free = sorted(name for name in edges if name not in below and edges[name] <= below)
        if not free:
            return placed
        placed.append(free)
        below |= set(free)
