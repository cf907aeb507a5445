"""The house as README draws it: few files at the root, rooms that do not lean on each other in circles."""

import ast
import configparser
import re
from collections import Counter
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
ROOT = REPOSITORY / "handover_marl"
#: Where packages lie, by name.
TOP = {"handover_marl": ROOT} | {
    f"handover_marl.{name}": REPOSITORY / name for name in ("givers", "receivers", "assets")
}


def modules() -> dict[str, Path]:
    """All modules of the library by name."""
    found = {}
    for package, folder in TOP.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return found


def room(module: str) -> str | None:
    """The room a module lies in; None for the modules at the root, which are in no room."""
    parts = module.split(".")[1:]
    if not parts or (ROOT / f"{parts[0]}.py").exists():
        return None
    # The generators are a room of their own: they use the simulator, what they made does not.
    return "assets.building" if parts[:2] == ["assets", "building"] else parts[0]


def imported(path: Path) -> set[str]:
    """What a module imports of the library, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("handover_marl"):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if alias.name.startswith("handover_marl")}
    known = modules()
    return {name for name in names if name in known}


def test_no_circle_of_rooms() -> None:
    edges: dict[str, set[str]] = {}
    for module, path in modules().items():
        own = room(module)
        if own is not None:
            others = {room(name) for name in imported(path)} - {None, own}
            edges.setdefault(own, set()).update(other for other in others if other)
    order: list[str] = []
    while len(order) < len(edges):
        free = sorted(name for name in edges if name not in order and edges[name] <= set(order))
        assert free, {name: sorted(edges[name] - set(order)) for name in edges if name not in order}
        order += free


def test_few_files_at_the_root() -> None:
    files = [path.name for path in ROOT.iterdir() if path.is_file()]
    assert len(files) <= 12, files


def test_only_the_bullet_room_touches_pybullet() -> None:
    users = {
        name for name, path in modules().items() if re.search(r"^\s*(import|from) pybullet\b", path.read_text(), re.M)
    }
    assert {name.rpartition(".")[0] for name in users} == {"handover_marl.sim.bullet"}


def test_only_its_room_touches_mujoco() -> None:
    users = {
        name for name, path in modules().items() if re.search(r"^\s*(import|from) mujoco\b", path.read_text(), re.M)
    }
    assert {name.rpartition(".")[0] for name in users} == {"handover_marl.sim.mujoco"}


def test_the_package_list_is_the_tree() -> None:
    setup = configparser.ConfigParser()
    setup.read(REPOSITORY / "setup.cfg")
    listed = setup["options"]["packages"].split()
    assert listed == sorted(listed)
    assert set(listed) == {name for name, path in modules().items() if path.name == "__init__.py"}


def test_a_name_means_one_thing() -> None:
    counts = Counter(path.stem for path in modules().values() if path.name != "__init__.py")
    assert [name for name, count in counts.items() if count > 1] == []


def test_tests_lie_where_modules_lie() -> None:
    rooms = {str(path.relative_to(REPOSITORY / "tests")) for path in (REPOSITORY / "tests").rglob("*") if path.is_dir()}
    there = {name for name in rooms if "__pycache__" not in name and name not in ("docs", "integration", "golden")}
    inside = {name.removeprefix("handover_marl.").replace(".", "/") for name in modules()}
    assert there <= inside
