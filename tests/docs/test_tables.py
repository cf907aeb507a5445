"""The tables of the documentation tell what the code does."""

import ast
import inspect
import re
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import handover_marl
from handover_marl.benchmarking.published import PUBLISHED
from handover_marl.config import OFFICIAL
from handover_marl.envs.rewards import SHAPED, SPARSE
from handover_marl.episode.observations import giver_observation_space, observation_space
from handover_marl.episode.sight import sight_space
from handover_marl.episode.spaces import giver_action_space, receiver_action_space
from tests.docs.pages import PAGES, REPOSITORY, checked_table, marks, name

ENVIRONMENT = REPOSITORY / "docs" / "environment.md"
BENCHMARK = REPOSITORY / "docs" / "benchmark.md"
RESULTS = REPOSITORY / "docs" / "results.md"
README = REPOSITORY / "README.md"
CHECKED = {
    "docs/environment.md": {
        "receiver actions",
        "giver actions",
        "shared observations",
        "giver observations",
        "sight observations",
        "rewards",
        "arguments",
    },
    "docs/benchmark.md": {"rules"},
}
SIGHTS = ("points", "clouds", "images")


def bare(cell: str) -> str:
    return cell.strip().strip("`")


def told_space(rows: list[list[str]]) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Shapes and types by key, as a table tells them."""
    return {bare(row[0]): (ast.literal_eval(row[1]), np.dtype(row[2])) for row in rows}


def true_space(space: spaces.Dict) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    return {key: (part.shape or (), np.dtype(part.dtype)) for key, part in space.spaces.items()}


def test_every_mark_is_looked_at() -> None:
    assert {name(page): marks(page) for page in PAGES if marks(page)} == CHECKED


@pytest.mark.parametrize(
    ("mark", "space"), [("receiver actions", receiver_action_space()), ("giver actions", giver_action_space())]
)
def test_actions(mark: str, space: spaces.Box) -> None:
    low, high = [], []
    for component, _, least, most in checked_table(ENVIRONMENT, mark):
        first, _, last = component.partition(" to ")
        assert int(first) == len(low)
        n = int(last or first) - int(first) + 1
        low += [float(least)] * n
        high += [float(most)] * n
    np.testing.assert_array_equal(np.float32(low), space.low)
    np.testing.assert_array_equal(np.float32(high), space.high)


def test_observations() -> None:
    shared = told_space(checked_table(ENVIRONMENT, "shared observations"))
    own = told_space(checked_table(ENVIRONMENT, "giver observations"))
    assert shared == true_space(observation_space())
    assert shared | own == true_space(giver_observation_space())


@pytest.mark.parametrize("sight", SIGHTS)
def test_sight(sight: str) -> None:
    rows = [row for row in checked_table(ENVIRONMENT, "sight observations") if f"`{sight}`" in row[3]]
    assert told_space(rows) == true_space(spaces.Dict(sight_space(sight)))


def test_state() -> None:
    env = handover_marl.parallel_env(dataset="synthetic")
    text = ENVIRONMENT.read_text()
    assert f"one vector of shape {env.state_space.shape} " in text
    assert f"({env.control_period} s unless told otherwise)" in text
    for agent in env.possible_agents:
        assert f"{agent} {env.action_space(agent).shape}" in text


def test_rewards() -> None:
    told = {(row[0], bare(row[1])): (float(row[2]), float(row[3])) for row in checked_table(ENVIRONMENT, "rewards")}
    sparse, shaped = asdict(SPARSE), asdict(SHAPED)
    agents = ("receiver", "giver")
    true = {(agent, term): (sparse[agent][term], shaped[agent][term]) for agent in agents for term in sparse[agent]}
    assert told == true


def test_arguments() -> None:
    told = {bare(row[0]): bare(row[1]) for row in checked_table(ENVIRONMENT, "arguments")}
    true = inspect.signature(handover_marl.HandoverEnv).parameters
    assert list(told) == list(true)
    for key, text in told.items():
        assert true[key].default == (OFFICIAL if text == "OFFICIAL" else ast.literal_eval(text)), key


def test_infos() -> None:
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast")
    _, infos = env.reset(seed=0)
    env.close()
    told = re.search(r"\| key \| meaning \|\n\|---\|---\|\n((?:\|.*\n)+)", ENVIRONMENT.read_text())
    assert told is not None
    keys = {bare(line.split("|")[1]) for line in told[1].splitlines()}
    assert keys == {"reward/..." if key.startswith("reward/") else key for key in infos["giver"]}


def test_rules() -> None:
    for _, field, value in checked_table(BENCHMARK, "rules"):
        assert getattr(OFFICIAL.protocol, bare(field)) == ast.literal_eval(value), field
    told = {bare(row[1]) for row in checked_table(BENCHMARK, "rules")}
    assert set(asdict(OFFICIAL.protocol)) - told == {"region_lower", "region_upper"}


def rows_of(text: str, first: str) -> list[list[str]]:
    """Rows of tables whose first cell says so."""
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [row for row in cells if row[0] == first]


def test_published_rows() -> None:
    told = rows_of(RESULTS.read_text(), "published")
    assert len(told) == 16
    for _, setup, episodes, success, seconds, contact, drop, timeout, average, wait in told:
        known = [
            row for row in PUBLISHED[setup] if (f"{row.success:.2f}", f"{row.time_exec:.3f}") == (success, seconds)
        ]
        assert len(known) == 1, (setup, success)
        row = known[0]
        assert (contact, drop, timeout) == (f"{row.contact:.2f}", f"{row.drop:.2f}", f"{row.timeout:.2f}")
        assert float(average) == pytest.approx(row.average_success, abs=0.051)
        assert float(wait) == row.wait
        assert int(episodes) in (144, 180, 360, 100)


@pytest.mark.parametrize("receiver", ["DexYCB", "`omg_hand_aware`", "`reactive`", "`gaddpg`", "published"])
def test_readme_shows_results(receiver: str) -> None:
    """README's table is a part of the whole one, where `yang2021` stands by its data."""
    whole = {tuple(_without_intervals(row[3:9])) for row in rows_of(RESULTS.read_text(), receiver) if row[1] == "s0"}
    names = {"DexYCB": "`yang2021`", "`gaddpg`": "`gaddpg`, own weights"}
    short = rows_of(README.read_text(), names.get(receiver, receiver))
    assert short
    assert {tuple(_without_intervals(row[2:8])) for row in short} <= whole


def _without_intervals(row: list[str]) -> list[str]:
    return [cell.partition(" (")[0] for cell in row]
