"""Tests of files with reference scores."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from handover_marl.errors import DataFormatError, DataNotFoundError
from handover_marl.evaluation.strangers.references import (
    Condition,
    Reference,
    ReferenceTable,
    load_references,
)
from handover_marl.policies.populations import load_population

CONDITION = Condition("receiver", "dexycb", "s0", "train", "fast", "0", "0.8.0", (3, 5, 9), ("a", "b", "c"))
GOOD = Reference("reactive", "0.8.0 abc", "handover-marl pair", (0.5, 0.0, 0.7))
BAD = Reference("hold", "0.8.0 abc", "handover-marl pair", (0.0, 0.3, 0.0))
POPULATION = load_population()
EMPTY = ReferenceTable(POPULATION, {})


def test_the_best_policy_stays() -> None:
    table = EMPTY.update(CONDITION, "fast", BAD).update(CONDITION, "fast", GOOD).update(CONDITION, "fast", BAD)
    assert table.sections[CONDITION]["fast"] == GOOD
    assert table.find(CONDITION, "fast") == GOOD


def test_scores_of_some_of_the_scenes() -> None:
    single = replace(CONDITION, scenes=(5,), data=("b",))
    table = EMPTY.update(CONDITION, "fast", GOOD).update(single, "fast", replace(BAD, scores=(0.3,)))
    assert table.find_all(replace(CONDITION, scenes=(3, 9), data=("a", "c")), ["fast"]) == (
        replace(GOOD, scores=(0.5, 0.7)),
    )
    # For scene 5, a higher score of another policy is stored under another condition.
    assert table.find_all(single, ["fast"]) == (replace(BAD, scores=(0.3,)),)
    assert table.find_all(CONDITION, ["fast", "slow"]) is None


def test_references_of_other_conditions_are_not_used() -> None:
    table = EMPTY.update(CONDITION, "fast", GOOD)
    others: list[dict[str, Any]] = [{"scenes": (3, 4), "data": ("a", "b")}, {"data": ("a", "b", "other hash")}]
    for changes in [*others, {"physics": "exact"}, {"split": "val"}, {"seed": "1"}, {"version": "0.9.0"}]:
        assert table.find(replace(CONDITION, **changes), "fast") is None


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "references.json"
    assert load_references(POPULATION, path, is_new=True) == EMPTY
    with pytest.raises(DataNotFoundError, match="references must be a file that"):
        load_references(POPULATION, path)
    table = EMPTY.update(CONDITION, "fast", GOOD)
    path.write_text(table.to_json())
    assert load_references(POPULATION, path) == table
    with pytest.raises(DataFormatError, match="must be of population def, got"):
        load_references(replace(POPULATION, content_hash="def"), path)
    for text in ("{", '{"population_hash": "", "sections": [1]}', path.read_text().replace("0.7", "0.7, 0.1")):
        path.write_text(text)
        with pytest.raises(DataFormatError, match="not a readable file of references"):
            load_references(POPULATION, path)
