"""Tests of the list of slow tests: it names existing tests, and is made from measured times."""

import ast
import re
from pathlib import Path

from tests.slow import module_name, read_slow_tests, select_slow_tests

REPOSITORY = Path(__file__).resolve().parents[1]


def test_every_listed_test_exists() -> None:
    functions: dict[str, set[str]] = {}
    stale = []
    for name in sorted(read_slow_tests()):
        module, _, function = name.partition("::")
        module = re.sub(r"\.[A-Z]\w*$", "", module)  # a class in the module
        if module not in functions:
            path = REPOSITORY / f"{module.replace('.', '/')}.py"
            tree = ast.parse(path.read_text()) if path.exists() else ast.Module([], [])
            functions[module] = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        if function not in functions[module]:
            stale.append(name)
    assert not stale, f"run make slow-tests; these tests do not exist: {stale}"


def test_the_slowest_are_selected(tmp_path: Path) -> None:
    cases = [("quick", 1.0), ("case[a]", 3.0), ("case[b]", 3.0), ("middle", 2.0)]
    lines = [f'<testcase classname="tests.test_x" name="{name}" time="{time}"/>' for name, time in cases]
    lines.append('<testcase classname="tests.test_language" name="always_selected" time="9.0"/>')
    report = tmp_path / "times.xml"
    report.write_text(f"<testsuites><testsuite>{''.join(lines)}</testsuite></testsuites>")
    assert select_slow_tests(report, fast_seconds=3.0) == {"tests.test_x::case": 6.0}
    assert select_slow_tests(report, fast_seconds=2.0) == {
        "tests.test_x::case": 6.0,
        "tests.test_x::middle": 2.0,
    }


def test_module_names() -> None:
    assert module_name("tests/envs/test_vector.py::test_reset[a::b]") == "tests.envs.test_vector"
    assert module_name("tests/envs/test_vector.py::TestApi::test_reset") == "tests.envs.test_vector.TestApi"
