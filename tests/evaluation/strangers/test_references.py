"""Tests of files with reference scores."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.errors import DataFormatError
from handover_marl.evaluation.strangers.references import (
    Condition,
    Reference,
    ReferenceTable,
    load_references,
    write_references,
)
from handover_marl.policies.populations import load_population

CONDITION = Condition("receiver", "dexycb", "s0", "train", "fast", (3, 5, 9))
GOOD = Reference("reactive", "0.8.0 abc", "handover-marl pair", (0.5, 0.0, 0.7))
BAD = Reference("hold", "0.8.0 abc", "handover-marl pair", (0.0, 0.3, 0.0))
EMPTY = ReferenceTable("abc", {})


def test_the_best_policy_stays() -> None:
    table = EMPTY.update(CONDITION, "fast", BAD).update(CONDITION, "fast", GOOD).update(CONDITION, "fast", BAD)
    assert table.sections[CONDITION]["fast"] == GOOD
    found = table.find(CONDITION, "fast")
    assert found is not None
    np.testing.assert_array_equal(found[1], GOOD.scores)


def test_scores_of_some_of_the_scenes() -> None:
    single = replace(CONDITION, scenes=(5,))
    table = EMPTY.update(CONDITION, "fast", GOOD).update(single, "fast", replace(BAD, scores=(0.3,)))
    part = table.collect_scores(replace(CONDITION, scenes=(3, 9)), ["fast"])
    np.testing.assert_array_equal(part, [[0.5, 0.7]])
    # For scene 5, a higher score of another policy is stored under another condition.
    np.testing.assert_array_equal(table.collect_scores(single, ["fast"]), [[0.3]])
    for changes in ({"scenes": (3, 4)}, {"physics": "exact"}, {"split": "val"}):
        assert table.collect_scores(replace(CONDITION, **changes), ["fast"]) is None
    assert table.collect_scores(CONDITION, ["fast", "slow"]) is None


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "references.json"
    assert load_references(path, "abc") == EMPTY
    table = EMPTY.update(CONDITION, "fast", GOOD)
    write_references(path, table)
    assert load_references(path, "abc") == table
    with pytest.raises(DataFormatError, match="must be of population def, got abc"):
        load_references(path, "def")
    for text in ("{", '{"population_hash": "abc", "sections": [1]}', path.read_text().replace("0.7", "7")):
        path.write_text(text)
        with pytest.raises(DataFormatError, match="not a readable file of references"):
            load_references(path, "abc")


@pytest.mark.parametrize(
    ("partners", "split", "scenes"),
    [("all", "train", (5, 430, 998)), ("test", "test", (209, 274, 349, 424))],
)
def test_shipped_references_have_all_givers(partners: str, split: str, scenes: tuple[int, ...]) -> None:
    population = load_population()
    table = load_references(population.references_path, population.content_hash)
    condition = Condition("receiver", "dexycb", "s0", split, "fast", scenes)
    scores = table.collect_scores(condition, [giver.name for giver in population.select("giver", partners)])
    assert scores is not None
    assert (scores.mean(axis=1) > 0.0).all()
