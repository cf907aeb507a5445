"""Scripts that search settings of scripted policies."""

import numpy as np
import pytest

from experiments.strangers.search_best_responses import SEARCH_SPACE, BestResponse, draw_policy, format_results
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.policies.populations import Partner
from handover_marl.policies.reference import parse_policy
from tests.learning.training.scripts import script


def check_draws(agent: str, name: str, space: dict[str, tuple[float, float]], logarithmic: bool) -> None:
    drawn = [draw_policy(name, space, np.random.default_rng((0, repeat)), logarithmic) for repeat in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]
    reference = parse_policy(agent, drawn[2])
    assert dict(reference.options).keys() == space.keys()
    assert all(low <= dict(reference.options)[key] <= high for key, (low, high) in space.items())
    reference.make(SyntheticDataset())


def test_drawn_settings_are_options() -> None:
    check_draws("receiver", "reactive", SEARCH_SPACE, logarithmic=True)


def test_giver_of_the_largest_score_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    search = script("search_giver", monkeypatch)
    check_draws("giver", "cooperative", search.SEARCH_SPACE, logarithmic=False)
    scores = {"replay": [0.5, 0.5], "a": [0.9, 0.4], "b": [0.6, 0.6], "c": [0.7, 0.8]}
    rows = [
        row.replace("|", " ").split() for row in search.format_results([("a", "b"), ("c",)], scores, "AS").splitlines()
    ]
    assert [(row[1], row[-1]) for row in rows[-3:]] == [("replay", "+0.0"), ("a", "+15.0"), ("c", "+25.0")]


def test_best_response_is_that_of_the_best_search() -> None:
    partners = (Partner("a", "f", "train", "a", "x"),)
    found = {(0, 1): BestResponse("second", 0.7, 1.0), (0, 0): BestResponse("first", 0.6, 0.9)}
    text = format_results(partners, found, 8)
    assert "60.0, 70.0" in text
    assert "second" in text
    assert "first" not in text
