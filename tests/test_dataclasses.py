"""Tests of the rules of dataclasses: they are frozen, and those with arrays are equal only to themselves."""

import ast
import functools
from pathlib import Path

from tests.import_graph import find_modules

#: Dataclasses whose fields change during an episode.
MUTABLE = {"PointCloudMemory", "_Rollout"}


@functools.cache
def find_dataclasses(path: Path) -> dict[str, tuple[set[str], bool]]:
    """Return, by class, the options of its decorator, such as "frozen=True", and whether it has array fields."""
    tree = ast.parse(path.read_text())
    aliases = {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign) and is_array(node.value, set())
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    found = {}
    for node in ast.walk(tree):
        for decorator in node.decorator_list if isinstance(node, ast.ClassDef) else ():
            if ast.unparse(decorator).partition("(")[0] == "dataclass":
                keywords = decorator.keywords if isinstance(decorator, ast.Call) else []
                annotations = [part.annotation for part in node.body if isinstance(part, ast.AnnAssign)]
                options = {ast.unparse(keyword).replace(" ", "") for keyword in keywords}
                found[node.name] = options, any(is_array(annotation, aliases) for annotation in annotations)
    return found


def is_array(annotation: ast.expr, aliases: set[str]) -> bool:
    """Return whether an annotation, or a part of a union, is an array type."""
    parts = [part.strip() for part in ast.unparse(annotation).split("|")]
    return any(part.startswith("npt.NDArray") or part in aliases for part in parts)


def test_dataclasses_are_frozen() -> None:
    wrong = [
        f"{module}.{name}"
        for module, path in find_modules().items()
        for name, (options, _) in find_dataclasses(path).items()
        if ("frozen=True" in options) == (name in MUTABLE)
    ]
    assert wrong == []


def test_dataclasses_with_arrays_are_compared_by_identity() -> None:
    """Dataclasses with array fields set eq=False, because a comparison of arrays has no single truth value."""
    wrong = [
        f"{module}.{name}"
        for module, path in find_modules().items()
        for name, (options, has_arrays) in find_dataclasses(path).items()
        if has_arrays and "eq=False" not in options and name not in MUTABLE
    ]
    assert wrong == []


def test_options_and_arrays_are_found(tmp_path: Path) -> None:
    file = tmp_path / "example.py"
    file.write_text(
        "Array = npt.NDArray[np.float64]\n"
        "@dataclass\nclass A:\n    x: int\n"
        "@dataclass(frozen=True, eq=False)\nclass B:\n    x: None | Array\n"
        "class C:\n    x: Array\n"
    )
    assert find_dataclasses(file) == {"A": (set(), False), "B": ({"frozen=True", "eq=False"}, True)}
