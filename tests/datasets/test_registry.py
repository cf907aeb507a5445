"""Tests of data sets by name, and of data whose scene numbers, setups and object classes differ from the official ones.

The generated data set in these tests has more than 1,000 scenes in a split, one setup, and classes from 22 on.
"""

import copy
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import open_dataset
from handover_marl.datasets.generated.dataset import FIRST_CLASS
from handover_marl.errors import OptionError, ResultsError, SceneError, UnknownNameError
from handover_marl.evaluation.merge import merge
from handover_marl.evaluation.metadata import CONFIG_FILE, ResultMetadata, format_config, read_result_metadata
from handover_marl.evaluation.reports.report import evaluate
from handover_marl.evaluation.verification import verify
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.policies.policy import make_policy_context

NAME, SCENES = "generated:n=2000,seed=7,procedural=1.0,objects=50", (1248, 1249)


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def evaluate_scenes(out: Path, **options: Any) -> handover_marl.Report:
    options = {"split": "train", "scenes": SCENES, "workers": 1, "progress": False, **options}
    return handover_marl.evaluate_pair(receiver="yang2021", dataset=NAME, physics="fast", out=out, **options)


@pytest.mark.parametrize("name", ["many", "generated", "dexycb:x", "synthetic:", "", ":", None, 3])
def test_names_that_do_not_exist(name: Any) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown dataset .*valid: auto, synthetic, "):
        open_dataset(name)


@pytest.mark.parametrize("name", ["synthetic", NAME])
def test_generated_scenes_need_no_folder(name: str) -> None:
    with pytest.raises(OptionError, match="need no data folder"):
        open_dataset(name, "/tmp")


def test_official_setups_and_scenes_are_the_default() -> None:
    dataset = open_dataset("synthetic")
    assert (dataset.n_scenes, dataset.setups[0], dataset.resolve_setup(None)) == (1000, "s0", "s0")
    assert dataset.list_scenes(None, "val") == dataset.list_scenes("s0", "val")
    assert dataset.object_names == CLASS_NAMES
    with pytest.raises(UnknownNameError, match="unknown setup 'all'; valid: s0, s1, s2, s3"):
        dataset.list_scenes("all", "val")
    with pytest.raises(SceneError, match="numbered 0 to 999"):
        dataset.check_scene_id(1000)


def test_environment_of_another_data_set() -> None:
    dataset = open_dataset(NAME)
    env = handover_marl.parallel_env(dataset=NAME, split="train", physics="fast", scenes=SCENES)
    assert (env.config.setup, env.scene_ids) == ("random", SCENES)
    observations, infos = env.reset(options={"scene_id": SCENES[0]})
    for agent, observation in observations.items():
        assert env.observation_space(agent).contains(observation)
        assert env.observation_space(agent)["object_classes"].high[0] == max(dataset.object_names)
    number = int(observations["receiver"]["object_classes"][0])
    assert number >= FIRST_CLASS
    assert infos["giver"]["scene_id"] == SCENES[0]
    assert env.policy_context.object_names[number] == env.object_names[0] == dataset.object_names[number]
    assert env.state_space.contains(env.state())
    env.close()
    context = make_policy_context(dataset)
    copies = copy.deepcopy(context), pickle.loads(pickle.dumps(context))
    assert {copied.setup for copied in copies} == {"random"}
    assert all(copied.object_names == dataset.object_names for copied in copies)


@pytest.mark.slow
def test_results_of_another_data_set(tmp_path: Path) -> None:
    """Results with numbers of four digits in their split are written, read again, verified, and merged from shards."""
    report = evaluate_scenes(tmp_path / "whole")
    assert (tmp_path / "whole" / "1005.npz").exists()
    metadata = read_result_metadata(tmp_path / "whole")
    n_split = len(open_dataset(NAME).list_scenes(None, "train"))
    assert (metadata.setup, metadata.dataset, metadata.n_split_scenes) == ("random", NAME, str(n_split))
    again = evaluate(tmp_path / "whole")
    assert again.episodes == report.episodes
    assert "data: generated scenes: n=2000" in again.heading
    assert f"2 of {n_split} scenes" in again.heading
    assert all(episode.object_name.startswith("object_") for episode in again.episodes)
    assert verify(tmp_path / "whole", workers=1, progress=False).is_verified
    for number in (1, 2):
        evaluate_scenes(tmp_path / str(number), shard=f"{number}/2")
    merged = merge([tmp_path / "2", tmp_path / "1"], tmp_path / "merged")
    assert isinstance(merged, handover_marl.Report)
    strip = [replace(episode, plan_s=0.0, machine=None) for episode in merged.episodes]
    assert strip == [replace(episode, plan_s=0.0, machine=None) for episode in report.episodes]


@pytest.mark.parametrize("size", ["0", "-3", "many", "12345678"])
def test_wrong_sizes_are_refused(tmp_path: Path, size: str) -> None:
    metadata = ResultMetadata("all", "test", "hold", "replay", "fast", "many:cups", "0.8.0", n_split_scenes=size)
    (tmp_path / CONFIG_FILE).write_text(format_config(metadata, OFFICIAL_CONFIG))
    with pytest.raises(ResultsError, match="beside which n_split_scenes must be a"):
        read_result_metadata(tmp_path)
