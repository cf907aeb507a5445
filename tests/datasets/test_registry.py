"""Tests of data sets by name, and of data whose scene numbers, setups and object classes differ from the official ones.

The generated data set in these tests has more than 1,000 scenes in a split, one setup, and classes from 22 on.
"""

import pickle
from pathlib import Path

import pytest

import handover_marl
from handover_marl.datasets import open_dataset
from handover_marl.datasets.generated.dataset import FIRST_CLASS
from handover_marl.errors import UnknownNameError
from handover_marl.evaluation.metadata import read_result_metadata
from handover_marl.evaluation.reports.report import load_report
from handover_marl.evaluation.verification import verify
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.policies.policy import make_policy_context
from tests.helpers.short_episodes import shorten_episodes

pytestmark = pytest.mark.usefixtures("own_cache")
NAME, SCENES = "generated:n=2000,seed=7,procedural=1.0,objects=50", (1248, 1249)


def test_official_setups_and_scenes_are_the_default() -> None:
    dataset = open_dataset("synthetic")
    assert (dataset.n_scenes, dataset.setups[0], dataset.resolve_setup(None)) == (1000, "s0", "s0")
    assert dataset.list_scenes(None, "val") == dataset.list_scenes("s0", "val")
    assert dataset.object_names == CLASS_NAMES
    with pytest.raises(UnknownNameError, match="unknown setup 'all'; valid: s0, s1, s2, s3"):
        dataset.list_scenes("all", "val")


@pytest.mark.slow
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
    copied = pickle.loads(pickle.dumps(context))
    assert (copied.setup, copied.object_names) == ("random", dataset.object_names)


@pytest.mark.slow
def test_results_of_another_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results with numbers of four digits in their split are written, read again and verified."""
    shorten_episodes(monkeypatch, 1000)
    options = {"dataset": NAME, "split": "train", "scenes": SCENES[1:], "physics": "fast", "workers": 1}
    report = handover_marl.evaluate_pair(receiver="hold", out=tmp_path / "out", progress=False, **options)
    assert (tmp_path / "out" / "1006.npz").exists()
    metadata = read_result_metadata(tmp_path / "out")
    n_split = len(open_dataset(NAME).list_scenes(None, "train"))
    assert (metadata.setup, metadata.dataset, metadata.n_split_scenes) == ("random", NAME, str(n_split))
    again = load_report(tmp_path / "out")
    assert again.episodes == report.episodes
    assert "data: generated scenes: n=2000" in again.heading
    assert f"1 of {n_split} scenes" in again.heading
    assert again.episodes[0].object_name.startswith("object_")
    assert verify(tmp_path / "out", workers=1, progress=False).is_verified
