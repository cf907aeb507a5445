"""Draw the packages of the library and the imports between them.

    python experiments/figures/draw_architecture.py --out docs/explanation/architecture.svg

An arrow from A to B means that a module of A imports a module of B. Packages are drawn in layers:
each imports only from layers below it.
"""

import ast
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import tyro

REPOSITORY = Path(__file__).resolve().parents[2]
#: Folder of each top-level package of the import tree.
FOLDERS = {"handover_marl": REPOSITORY / "handover_marl"} | {
    f"handover_marl.{name}": REPOSITORY / name for name in ("givers", "receivers", "assets")
}
#: Subpackages that are drawn apart from their parents, because they import packages that import the parent.
DRAWN_APART = ("learning.imitation", "learning.networks", "learning.training", "assets.building")
_BOX_WIDTH, _BOX_HEIGHT, _ROW_HEIGHT = 1.7, 0.5, 1.25


@dataclass(frozen=True)
class Args:
    """Options of the architecture figure.

    Attributes:
        out: SVG file to write.
    """

    out: Path = REPOSITORY / "docs" / "explanation" / "architecture.svg"


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
    """Return the package to which a module belongs in the figure; None for modules at the root.

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


def remove_implied_edges(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the edges of a graph without those that a path of other edges implies.

    Args:
        edges: Names to which edges lead, by the name from which they start; without cycles.
    """

    def reach(name: str) -> set[str]:
        return edges[name].union(*(reach(other) for other in edges[name]))

    return {name: {to for to in out if not any(to in reach(mid) for mid in out - {to})} for name, out in edges.items()}


def draw(out: Path) -> None:
    """Write the figure as an SVG file; arrows that other arrows imply are left out."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    edges = build_package_graph()
    rows = sort_into_layers(edges)
    centers = {
        name: ((column - (len(row) - 1) / 2) * (_BOX_WIDTH + 0.5), height * _ROW_HEIGHT)
        for height, row in enumerate(rows)
        for column, name in enumerate(row)
    }
    with mpl.rc_context({"svg.hashsalt": "architecture", "svg.fonttype": "none"}):
        figure, axes = plt.subplots(figsize=(8.0, 0.8 * len(rows)))
        for start, ends in remove_implied_edges(edges).items():
            for end in ends:
                (x0, y0), (x1, y1) = centers[start], centers[end]
                arrow = axes.annotate(
                    "",
                    xy=(x1, y1 + _BOX_HEIGHT / 2),
                    xytext=(x0, y0 - _BOX_HEIGHT / 2),
                    arrowprops={"arrowstyle": "->", "color": "0.45", "linewidth": 0.9},
                )
                if arrow.arrow_patch is not None:
                    arrow.arrow_patch.set_gid(f"{start} imports {end}")
        for name, (x, y) in centers.items():
            box = {"boxstyle": "round,pad=0.35", "facecolor": "#e8f0fb", "edgecolor": "#5b7db1"}
            axes.text(x, y, name, ha="center", va="center", fontsize=9, bbox=box, gid=name)
        xs, ys = zip(*centers.values(), strict=True)
        axes.set_xlim(min(xs) - _BOX_WIDTH, max(xs) + _BOX_WIDTH)
        axes.set_ylim(min(ys) - _BOX_HEIGHT, max(ys) + _BOX_HEIGHT)
        axes.axis("off")
        out.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
        plt.close(figure)
    print(f"The picture of the packages is in {out}")


if __name__ == "__main__":
    draw(tyro.cli(Args).out)
