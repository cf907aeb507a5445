import pytest

from tests.learning.training.scripts import script


def test_equivalent_mutants_are_changes_of_present_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    mutation_testing = script("mutation_testing", monkeypatch)
    known = mutation_testing.read_equivalent_mutants()
    assert known.keys() <= mutation_testing.TESTS.keys()
    for module, changes in known.items():
        lines = (mutation_testing.REPOSITORY / module).read_text().splitlines()
        for change in changes:
            removed = [line[1:] for line in change.splitlines() if line.startswith("-")]
            assert removed, change
            assert set(removed) <= set(lines), f"{module} has changed: remove or update\n{change}"


def test_table_counts_equivalent_mutants_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    mutation_testing = script("mutation_testing", monkeypatch)
    difference = "--- \n+++ \n@@ -1 +1 @@\n x\n-a = b + c\n+a = b | c"
    results = [mutation_testing.ModuleResult("m.py", 20, [difference, difference.replace("|", "-")])]
    rows = mutation_testing.build_rows(results, {"m.py": {"-a = b + c\n+a = b | c"}})
    assert [row[:4] for row in rows] == [["m.py", 20, "90.0", 1], ["all", 20, "90.0", 1]]
    assert [row[4].split()[0] for row in rows] == ["94.7", "94.7"]
