"""Scripts that search settings of scripted policies."""

import numpy as np

from experiments.strangers.search_best_responses import SEARCH_SPACE, draw_policy, format_results
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.policies.populations import Partner
from handover_marl.policies.reference import parse_policy
from tests.evaluation.reports.test_report import report


def test_drawn_settings_are_options() -> None:
    drawn = [draw_policy(np.random.default_rng((0, repeat))) for repeat in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]
    reference = parse_policy("receiver", drawn[2])
    assert dict(reference.options).keys() == SEARCH_SPACE.keys()
    assert all(low <= dict(reference.options)[key] <= high for key, (low, high) in SEARCH_SPACE.items())
    reference.make(SyntheticDataset())


def test_best_response_is_that_of_the_best_search() -> None:
    partners = (Partner("a", "f", "train", "a", "x"),)
    found = {(0, 1): report(1, 1, receiver="second"), (0, 0): report(1, 2, receiver="first")}
    text = format_results(partners, found)
    assert "30.8, 61.5" in text
    assert "second" in text
    assert "first" not in text
