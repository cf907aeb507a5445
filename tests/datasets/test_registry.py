"""Tests of data sets whose scene numbers, setups and object classes differ from the official ones."""

import copy
import pickle
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import Dataset, open_dataset, registry
from handover_marl.datasets.dataset import Scene, SceneInfo
from handover_marl.datasets.registry import DatasetKind
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ResultsError, SceneError, UnknownNameError
from handover_marl.evaluation.merge import merge
from handover_marl.evaluation.metadata import CONFIG_FILE, ResultMetadata, format_config, read_result_metadata
from handover_marl.evaluation.reports.report import evaluate
from handover_marl.evaluation.verification import verify
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.policies.policy import make_policy_context
from tests.learning.grasps import select_grasp

N_SCENES, CUP = 1500, 29


class ManyScenes(SyntheticDataset):
    """Synthetic scenes that repeat from number 1000 on, with mugs in a class of their own, `cup`."""

    name = "many:cups"

    @property
    def n_scenes(self) -> int:
        """Number of scenes."""
        return N_SCENES

    @property
    def setups(self) -> tuple[str, ...]:
        """Name of the only setup."""
        return ("all",)

    @property
    def object_names(self) -> Mapping[int, str]:
        """Names of the YCB classes and of the class `cup`, by number."""
        return {**CLASS_NAMES, CUP: "cup"}

    def list_scenes(self, setup: str | None, split: str) -> tuple[int, ...]:
        """Return all scenes, which are in every split."""
        self.resolve_setup(setup)
        return tuple(range(N_SCENES))

    def load_info(self, scene_id: int) -> SceneInfo:
        """Return a scene's info, in which mugs are cups."""
        self.check_scene_id(scene_id)
        return rename(super().load_info(scene_id % 1000), scene_id)

    def load_scene(self, scene_id: int) -> Scene:
        """Return a scene, in which mugs are cups."""
        self.check_scene_id(scene_id)
        scene = super().load_scene(scene_id % 1000)
        return replace(scene, info=rename(scene.info, scene_id), dataset=self.name)

    def find_object_urdf(self, object_name: str) -> Path:
        """Return the URDF of an object; a cup has that of the mug."""
        return super().find_object_urdf(object_name.replace("cup", "025_mug"))

    def load_grasps(self, object_name: str) -> Any:
        """Return the grasps of an object; a cup has those of the mug."""
        return super().load_grasps(object_name.replace("cup", "025_mug"))


def rename(info: SceneInfo, scene_id: int) -> SceneInfo:
    ids = tuple(CUP if number == 14 else number for number in info.object_ids)
    names = tuple("cup" if name == "025_mug" else name for name in info.object_names)
    return replace(info, scene_id=scene_id, object_ids=ids, object_names=names)


@pytest.fixture
def many(monkeypatch: pytest.MonkeyPatch) -> Dataset:
    kind = DatasetKind("many scenes", "many:NAME", lambda argument, data_dir, robot: ManyScenes(robot))
    monkeypatch.setattr(registry, "KINDS", {**registry.KINDS, "many": kind})
    return open_dataset("many:cups")


#: Scenes with a mug (number 13 of the official objects).
SCENES = (1069, 1165)


def evaluate_scenes(out: Path, **options: Any) -> handover_marl.Report:
    return handover_marl.evaluate_pair(
        receiver="yang2021", dataset="many:cups", physics="fast", scenes=SCENES, workers=1, out=out, **options
    )


@pytest.mark.parametrize("name", ["many", "many:", "many:a", "dexycb:x", "synthetic:", "", ":", None, 3])
def test_names_that_do_not_exist(name: Any) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown dataset .*valid: auto, synthetic, "):
        open_dataset(name)


def test_official_setups_and_scenes_are_the_default() -> None:
    dataset = open_dataset("synthetic")
    assert (dataset.n_scenes, dataset.setups[0], dataset.resolve_setup(None)) == (1000, "s0", "s0")
    assert dataset.list_scenes(None, "val") == dataset.list_scenes("s0", "val")
    assert dataset.object_names == CLASS_NAMES
    with pytest.raises(UnknownNameError, match="unknown setup 'all'; valid: s0, s1, s2, s3"):
        dataset.list_scenes("all", "val")
    with pytest.raises(SceneError, match="numbered 0 to 999"):
        dataset.check_scene_id(1000)


def test_environment_of_another_data_set(many: Dataset) -> None:
    env = handover_marl.parallel_env(dataset="many:cups", physics="fast", scenes=SCENES)
    assert (env.config.setup, env.scene_ids) == ("all", SCENES)
    observations, infos = env.reset(options={"scene_id": SCENES[0]})
    for agent, observation in observations.items():
        assert env.observation_space(agent).contains(observation)
        assert env.observation_space(agent)["object_classes"].high[0] == CUP
    assert infos["giver"]["scene_id"] == SCENES[0]
    assert observations["receiver"]["object_classes"][0] == CUP
    assert env.policy_context.object_names[CUP] == env.object_names[0] == "cup"
    assert env.state_space.contains(env.state())
    env.close()


def test_policies_name_the_classes_of_the_data_set(many: Dataset) -> None:
    context = make_policy_context(many)
    assert copy.deepcopy(context).object_names == pickle.loads(pickle.dumps(context)).object_names == many.object_names
    assert context.setup == "all"
    env = handover_marl.parallel_env(dataset="many:cups", physics="fast", scenes=SCENES)
    observation = env.reset(options={"scene_id": SCENES[0]})[0]["receiver"]
    env.close()
    found = select_grasp(context, observation)
    as_mug = {**observation, "object_classes": np.where(observation["object_classes"] == CUP, 14, 0)}
    expected = select_grasp(make_policy_context(SyntheticDataset()), as_mug)
    assert found is not None
    assert expected is not None
    np.testing.assert_array_equal(found[0], expected[0])


def test_results_of_another_data_set(many: Dataset, tmp_path: Path) -> None:
    """Results with scene numbers of four digits are written, read again, verified, and merged from shards."""
    report = evaluate_scenes(tmp_path / "whole")
    assert (tmp_path / "whole" / "1069.npz").exists()
    metadata = read_result_metadata(tmp_path / "whole")
    assert (metadata.setup, metadata.dataset, metadata.n_split_scenes) == ("all", "many:cups", str(N_SCENES))
    again = evaluate(tmp_path / "whole")
    assert again.episodes == report.episodes
    assert "data: many scenes: cups" in again.heading
    assert f"2 of {N_SCENES} scenes" in again.heading
    assert [episode.object_name for episode in again.episodes] == ["cup", "cup"]
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
