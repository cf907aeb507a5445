"""Tests of the data cards (`README.md`) of recorded data sets."""

from dataclasses import replace

import pytest
import yaml

from handover_marl.datasets.splits import SPLIT_SIZES
from handover_marl.episode.observations import receiver_observation_space
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import OBS_MODES
from handover_marl.evaluation.demonstrations.data_card import DataCard, FeatureRow
from handover_marl.evaluation.demonstrations.observation_meanings import OBSERVATION_MEANINGS
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.evaluation.results.metadata import ResultMetadata

SOURCE = ResultMetadata(
    "s1", "train", "yang2021", "replay", "exact", "dexycb", "0.8.0", recorded="demonstrations, obs_mode state+rgbd, x"
)
SUCCESS = EpisodeResult(0, EpisodeStatus.SUCCESS, 5000, 0.1, scene_id=5, models="stand-in hand")
DROP = replace(SUCCESS, index=1, status=EpisodeStatus.OBJECT_DROP, scene_id=6)
CARD = DataCard(
    SOURCE,
    "a layout",
    [SUCCESS, DROP],
    [SUCCESS, DROP],
    "Two episodes.",
    "frame",
    [FeatureRow("a", "(3,)", "f", "x|y")],
)


def command_of(card: DataCard) -> str:
    (line,) = [line for line in card.format().splitlines() if line.startswith("handover-marl")]
    return line


def test_contents() -> None:
    text = replace(CARD, front_matter="- LeRobot\n").format()
    header, body = text.split("---\n")[1:3]
    assert yaml.safe_load(header)["tags"][-1] == "LeRobot"
    assert "2 simulated handovers" in body
    assert "Two episodes." in body
    assert "| `a` | (3,) | f | x\\|y |" in body
    assert "| models that are not HandoverSim's | stand-in hand |" in body
    assert [line.split() for line in body.splitlines() if line.startswith(("| drop", "| succ", "| all"))] == [
        ["|", "drop", "|", "1", "|", "1", "|"],
        ["|", "success", "|", "1", "|", "1", "|"],
        ["|", "all", "|", "2", "|", "2", "|"],
    ]
    assert "world and rules" not in body
    assert "not the official ones, hash abc" in replace(CARD, evaluation=replace(SOURCE, world="abc")).format()


@pytest.mark.parametrize(("dataset", "licence"), [("dexycb", "cc-by-nc-4.0"), ("synthetic", "mit")])
def test_the_licence_is_that_of_the_scenes(dataset: str, licence: str) -> None:
    text = replace(CARD, evaluation=replace(SOURCE, dataset=dataset)).format()
    assert yaml.safe_load(text.split("---\n")[1])["license"] == licence
    assert ("CC BY-NC 4.0" in text) == (dataset == "dexycb")
    assert ("no recording of a person" in text) == (dataset == "synthetic")


def test_the_command_makes_the_data_set() -> None:
    first = "handover-marl demonstrate --receiver yang2021 --dataset dexycb --setup s1 --split train"
    assert command_of(CARD) == f"{first} --obs-mode state+rgbd --scenes 5,6 --out DIR"
    whole = [SUCCESS] * SPLIT_SIZES["s1", "train"]
    card = replace(CARD, simulated=whole, recorded=whole, arguments=("--format", "lerobot"))
    assert command_of(card) == f"{first} --obs-mode state+rgbd --format lerobot --out DIR"
    card = replace(CARD, recorded=[SUCCESS], evaluation=replace(SOURCE, giver="noisy", physics="fast", seed="3"))
    assert command_of(card) == (
        f"{first.replace('--dataset', '--giver noisy --dataset')} --physics fast --seed 3 --obs-mode state+rgbd "
        "--keep success --scenes 5,6 --out DIR"
    )


def test_cards_explain_every_observation() -> None:
    keys = {key for obs_mode in OBS_MODES for key in receiver_observation_space(obs_mode)}
    assert keys == set(OBSERVATION_MEANINGS)
