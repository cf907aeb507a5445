"""Scripts that select the population and measure the spread of recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.strangers.measure_recording_spread import (
    ALL_OBJECTS,
    RecordedHandover,
    compute_residuals,
    format_spread,
    measure_handover,
    measure_spread,
)
from experiments.strangers.search_best_responses import SEARCH_SPACE, BestResponse, draw_policy, format_results
from experiments.strangers.select_population import (
    CANDIDATES,
    EVENTS,
    copy_policy_files,
    format_features,
    select_by_family,
)
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.policies.populations import Partner, load_population
from handover_marl.policies.reference import parse_policy
from tests.learning.training.scripts import script


def test_selection_by_family() -> None:
    givers = [Partner(f"{family}{n}", family, "train", f"{family}:{n}", "x") for family in "ab" for n in range(3)]
    features = np.array([[1, 0, 0], [0.9, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [0, 0.9, 0]], dtype=float)
    chosen = select_by_family(givers, features, 2)
    assert [giver.name for giver in chosen] == ["a0", "a2", "b0", "b1"]
    text = format_features(givers, np.zeros((6, len(EVENTS))), chosen)
    assert text.count("yes") == 4


def test_candidates_include_the_shipped_givers() -> None:
    policies = {giver.policy for giver in load_population(CANDIDATES).givers}
    shipped = load_population()
    assert {giver.policy for giver in shipped.givers} <= policies


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


def test_policy_files_of_chosen_givers_are_copied(tmp_path: Path) -> None:
    folder = tmp_path / "population"
    folder.mkdir()
    for name in ("chosen.npz", "other.npz"):
        (tmp_path / name).write_text(name)
    plain = Partner("plain", "a", "train", "replay", "x")
    givers = plain, *(Partner(name, "b", "test", f"learned:{{folder}}/{name}.npz", "x") for name in ("chosen", "other"))
    population = replace(load_population(), givers=givers, path=tmp_path / "candidates.json")
    copy_policy_files(population, givers[:2], folder)
    assert [path.name for path in folder.iterdir()] == ["chosen.npz"]
    assert (folder / "chosen.npz").read_text() == "chosen.npz"


def test_spread_is_relative_to_the_mean_of_a_group() -> None:
    group = [
        RecordedHandover(np.array([0.0, 0.1 * n, 0.0]), Rotation.from_rotvec([0.0, 0.0, 0.2 * n]), float(np.exp(n)))
        for n in (-1, 0, 1)
    ]
    residuals = compute_residuals(group)
    np.testing.assert_allclose(residuals[:, 1], [-0.1, 0.0, 0.1], atol=1e-9)
    np.testing.assert_allclose(residuals[:, 5], [-0.2, 0.0, 0.2], atol=1e-9)
    np.testing.assert_allclose(residuals[:, 6], [-1.0, 0.0, 1.0], atol=1e-9)
    spread = format_spread([residuals])
    assert spread["displacement"] == [0.0, 0.1, 0.0]
    assert spread["n"] == 3


def test_spread_of_recordings() -> None:
    dataset = SyntheticDataset()
    handover = measure_handover(dataset.load_scene(9))
    assert handover is not None
    assert 0.1 < handover.duration < 5.0
    assert handover.position[2] == pytest.approx(1.2, abs=0.4)
    found = measure_spread(dataset, [5, 6, 7, 8, 9])
    assert set(found) == {ALL_OBJECTS, dataset.load_scene(9).info.target_name}
