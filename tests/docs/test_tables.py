"""Tests of the tables of the documentation: they agree with the code."""

import ast
import csv
import dataclasses
import re
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import handover_marl
from handover_marl import givers
from handover_marl.config import OFFICIAL_CONFIG, CheckedConfig
from handover_marl.datasets.generated.config import FAMILY_DEFAULTS
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.envs import rewards
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.rewards import SHAPED, SPARSE
from handover_marl.episode.camera_observations import camera_observation_space
from handover_marl.episode.observations import giver_observation_space, state_space
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import giver_action_space, receiver_action_space
from handover_marl.evaluation.comparison import Comparison
from handover_marl.evaluation.crossplay import CrossPlay
from handover_marl.evaluation.reports import tables
from handover_marl.evaluation.reports.report import Report, ReportList, render_report_page
from handover_marl.evaluation.reports.tables import SCENE_HEADER, Column, build_scene_table
from handover_marl.evaluation.verification import Difference, Verification
from tests.docs.pages import PAGES, REPOSITORY, checked_table, marks
from tests.evaluation.quick import make_report

ENVIRONMENT = REPOSITORY / "docs" / "reference" / "environment.md"
METRICS = REPOSITORY / "docs" / "reference" / "metrics.md"
REWARDS = REPOSITORY / "docs" / "reference" / "rewards.md"
#: Marks of the tables that are checked here, in `tests/receivers/test_information.py`, `tests/test_architecture.py`,
#: `tests/evaluation/test_inference_time.py` and `tests/receivers/test_recorded_frames.py`.
#: Those of features and action schemes, which have a slash, are checked in `tests/docs/test_feature_tables.py`.
CHECKED = {
    *("receiver actions", "giver actions", "rewards", "reward terms", "generated scenes", "receiver inputs"),
    *("shared observations", "giver observations", "camera observations"),
    *("rules", "official metrics", "fluency metrics", "episode columns", "identity", "comparison columns"),
    *("packages", "inference time", "driver inputs", "arguments", "givers"),
}
OFFICIAL = (tables.N_EPISODES, *tables.RATES, *tables.COUNTS, tables.AVERAGE_SUCCESS, tables.WAIT, *tables.TIMES)
CAMERA_DATA = ("pointcloud", "full_pointcloud", "rgbd", "rgb", "depth", "segmentation", "point_map")


def test_parameters_of_generated_scenes() -> None:
    rows = checked_table(REPOSITORY / "docs" / "how_to" / "generate_scenes.md", "generated scenes")
    for column, family in ((1, "default"), (2, "hard")):
        documented = {bare(row[0]): row[column] for row in rows}
        assert documented == {name: str(value) for name, value in asdict(FAMILY_DEFAULTS[family]).items()}


def bare(cell: str) -> str:
    return cell.strip().strip("`")


def documented_space(rows: list[list[str]]) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Return shapes and types by key, from the rows of a table."""
    return {bare(row[0]): (ast.literal_eval(row[1]), np.dtype(row[2])) for row in rows}


def actual_space(space: spaces.Dict) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    return {key: (part.shape or (), np.dtype(part.dtype)) for key, part in space.spaces.items()}


def test_every_mark_is_checked() -> None:
    assert {mark for page in PAGES for mark in marks(page) if "/" not in mark} == CHECKED


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
    shared = documented_space(checked_table(ENVIRONMENT, "shared observations"))
    own = documented_space(checked_table(ENVIRONMENT, "giver observations"))
    assert shared == actual_space(state_space())
    assert shared | own == actual_space(giver_observation_space())


@pytest.mark.parametrize("data", CAMERA_DATA)
def test_camera_observations(data: str) -> None:
    rows = [row for row in checked_table(ENVIRONMENT, "camera observations") if f"`{data}`" in row[3]]
    assert documented_space(rows) == actual_space(spaces.Dict(camera_observation_space(data)))


def test_state_and_infos() -> None:
    env = handover_marl.parallel_env(dataset="synthetic", physics="fast")
    _, infos = env.reset(seed=0)
    env.close()
    text = ENVIRONMENT.read_text()
    assert f"one vector of shape {env.state_space.shape} " in text
    assert f"({env.config.control_period} s by default)" in text
    for agent in env.possible_agents:
        assert f"{agent} {env.action_space(agent).shape}" in text
    documented = re.search(r"\| key \| meaning \|\n\|---\|---\|\n((?:\|.*\n)+)", text)
    assert documented is not None
    keys = {bare(line.split("|")[1]) for line in documented[1].splitlines()}
    assert keys == {"reward/..." if key.startswith("reward/") else key for key in infos["giver"]}


def test_arguments_of_environments() -> None:
    rows = checked_table(ENVIRONMENT, "arguments")
    defaults = {field.name: repr(field.default).replace("'", '"') for field in dataclasses.fields(EnvConfig)}
    assert defaults["world_config"] == repr(OFFICIAL_CONFIG).replace("'", '"')
    assert {bare(row[0]): bare(row[1]) for row in rows} == defaults | {"world_config": "OFFICIAL_CONFIG"}


def test_options_of_givers() -> None:
    rows = checked_table(REPOSITORY / "docs" / "reference" / "policies.md", "givers")
    assert sorted(bare(row[0]).partition(":")[0] for row in rows) == sorted(givers.list_available())
    for row in rows:
        config = getattr(givers.make(bare(row[0]), SyntheticDataset()), "config", None) if ":" not in row[0] else None
        documented = {name: float(value) for name, value in re.findall(r"`(\w+)` (-?[\d.]+)", row[2])}
        assert documented == (asdict(config) if isinstance(config, CheckedConfig) else {}), row[0]


def test_rewards() -> None:
    rows = checked_table(REWARDS, "rewards")
    true = {
        (agent, term): (getattr(SPARSE, agent).get(term, 0.0), weight)
        for agent in ("receiver", "giver")
        for term, weight in getattr(SHAPED, agent).items()
    }
    assert {(row[0], bare(row[1])): (float(row[2]), float(row[3])) for row in rows} == true


def test_reward_terms() -> None:
    """The page has all terms; `tests/envs/test_rewards.py` checks their values."""
    assert [bare(row[0]) for row in checked_table(REWARDS, "reward terms")] == [*rewards.TERMS]


def test_rules() -> None:
    for _, field, value in checked_table(ENVIRONMENT, "rules"):
        assert getattr(OFFICIAL_CONFIG.protocol, bare(field)) == ast.literal_eval(value), field
    documented = {bare(row[1]) for row in checked_table(ENVIRONMENT, "rules")}
    assert set(asdict(OFFICIAL_CONFIG.protocol)) - documented == {"region_lower", "region_upper"}


def documented_names(mark: str, column: int = 0) -> list[str]:
    return [word for row in checked_table(METRICS, mark) for word in re.findall(r"`([^`]+)`", row[column])]


def sample_report(physics: str = "exact", *statuses: int) -> Report:
    stored = make_report()
    metadata = dataclasses.replace(stored.metadata, physics=physics)
    episodes = zip(stored.episodes, statuses or (1, 2), strict=True)
    ended = tuple(dataclasses.replace(episode, status=EpisodeStatus(status)) for episode, status in episodes)
    return Report(metadata, ended)


def sample_crossplay() -> CrossPlay:
    givers, receivers = ("one", "two"), ("RECEIVER", "OTHER")
    return CrossPlay({(g, r): sample_report() for g in givers for r in receivers})


@pytest.mark.parametrize(
    ("mark", "group", "columns"),
    [("official metrics", "", OFFICIAL), ("fluency metrics", "fluency.", tables.FLUENCY)],
)
def test_metrics_have_one_name(mark: str, group: str, columns: tuple[Column, ...]) -> None:
    """The page names the title in tables, the key in JSON and the key in CSV of every metric as the code does."""
    rows = checked_table(METRICS, mark)
    assert [bare(row[0]) for row in rows] == [column.title for column in columns]
    report, header = sample_report().to_json(), next(csv.reader(sample_crossplay().to_csv().splitlines()))
    for column, row in zip(columns, rows, strict=True):
        path = bare(row[1])
        csv_key = bare(row[2]) if mark == "official metrics" else path
        if column.key.startswith("n_") and column.key != "n_episodes":
            continue
        assert column.key in path.split(".")
        assert csv_key == column.key
        assert csv_key in header
        value: Any = report
        for key in f"{group}{path}".split("."):
            value = value[key]


def test_every_printed_column_is_documented() -> None:
    first, other = sample_report(), sample_report("fast", 2, 1)
    compared = Comparison(other, first)
    page = render_report_page(first)
    verified = str(Verification(first.metadata, (209,), (Difference(209, "steps", "1", "2"),))).split("\n\n")
    (row,) = [part.splitlines()[0] for part in verified if part.startswith("|")]
    tables = [*first.build_tables(), *ReportList((first, other)).build_tables(), build_scene_table(first.episodes)]
    tables += [*sample_crossplay().build_tables(), *compared.build_tables()]
    titles = {str(title) for table in tables for title in table.header}
    titles |= {cell.strip() for cell in row.strip("|").split("|")}
    titles |= set(re.findall(r"<th[^>]*>([^<]+)</th>", page))
    for old, new in {"OTHER": "RECEIVER", "fast": "A", "exact": "B"}.items():
        titles = {re.sub(rf"\b{old}\b", new, title) for title in titles}
    marks = ("official metrics", "fluency metrics", "episode columns", "comparison columns")
    documented = {name for mark in marks for name in documented_names(mark)}
    assert titles <= documented, titles - documented
    assert documented_names("episode columns")[: len(SCENE_HEADER)] == list(SCENE_HEADER)


def test_every_key_is_documented() -> None:
    report = sample_report().to_json()
    identity = set(documented_names("identity"))
    assert {*report, "inference_time"} == identity
    assert set(report["episodes"][0]) == set(documented_names("episode columns", 1))  # type: ignore[index]
    fluency = documented_names("fluency metrics", 1)
    assert list(report["fluency"]) == list(report["episodes"][0]["fluency"]) == fluency  # type: ignore[index, call-overload]
    header = next(csv.reader(sample_crossplay().to_csv().splitlines()))
    keys = {re.sub("_(low|high|n)$", "", key) for key in header}
    assert keys == {*header} & identity | set(documented_names("official metrics", 2)) - {"exec_s_n"} | set(fluency)
