"""Tests that LeRobot's own reader reads data sets in the format `lerobot`; `make lerobot` installs LeRobot."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.evaluation.demonstrations.demonstration import Demonstration
from tests.evaluation.demonstrations.lerobot.reading import read_frames
from tests.evaluation.demonstrations.recording import SCENES, record

pytest.importorskip("lerobot")
FPS = 10


@pytest.fixture(scope="module", autouse=True)
def operators() -> None:
    """Declare operators that torchvision's wheel lacks if PyTorch has no CUDA; LeRobot does not use them."""
    import torch

    if torch.version.cuda is None:
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


@pytest.fixture(scope="module", params=["state+pointcloud", "rgbd"])
def obs_mode(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def out(obs_mode: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lerobot") / "out"
    record(None, folder, format="lerobot", fps=FPS, obs_mode=obs_mode, giver="noisy")
    return folder


@pytest.fixture(scope="module")
def decisions(obs_mode: str, tmp_path_factory: pytest.TempPathFactory) -> list[Demonstration]:
    """Return the same episodes, recorded in Minari's format."""
    return list(record(None, tmp_path_factory.mktemp("minari") / "out", obs_mode=obs_mode, giver="noisy"))


def load(out: Path, **options: Any) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    assert os.environ.get("HF_HUB_OFFLINE"), "nothing is to be downloaded"
    return LeRobotDataset("local/handovers", root=out / "lerobot", **options)


def test_frames(out: Path, obs_mode: str, decisions: list[Demonstration]) -> None:
    dataset = load(out)
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (2, 12, FPS)
    columns = [read_frames(out, number) for number in range(2)]
    for index in range(len(dataset)):
        item, (episode, frame) = dataset[index], divmod(index, 6)
        assert (item["index"].item(), item["episode_index"].item(), item["frame_index"].item()) == (
            index,
            episode,
            frame,
        )
        assert item["timestamp"].item() == pytest.approx(frame / FPS)
        assert item["task"] == "Take the cracker box from the person's hand."
        assert item["next.done"].item() is (frame == 5)
        for name, values in columns[episode].items():
            np.testing.assert_array_equal(item[name].numpy(), values[frame], err_msg=name)
        demonstration = decisions[episode]
        now = np.searchsorted(demonstration.steps[:-1], 100 * frame, side="right") - 1
        np.testing.assert_array_equal(item["action"].numpy(), demonstration.actions[now])
        if frame == 0:
            for name, array in demonstration.observations.items():
                if f"observation.{name}" in item:
                    np.testing.assert_array_equal(item[f"observation.{name}"].numpy(), array[0], err_msg=name)
    assert ("observation.environment_state" in dataset.features) == obs_mode.startswith("state")


def test_videos(out: Path, obs_mode: str, decisions: list[Demonstration]) -> None:
    dataset, key = load(out), "observation.images.wrist"
    assert dataset.meta.video_keys == ([key] if obs_mode == "rgbd" else [])
    if obs_mode == "rgbd":
        for episode, demonstration in enumerate(decisions):
            picture = dataset[6 * episode][key].numpy()
            assert picture.shape == (3, 224, 224)
            expected = np.moveaxis(demonstration.observations["wrist_rgb"][0], -1, 0) / 255.0
            assert np.abs(picture - expected).mean() < 0.015
        # Frames differ, since the arm moves.
        assert (dataset[0][key] - dataset[5][key]).abs().mean() > 0.001


def test_metadata(out: Path) -> None:
    meta = load(out).meta
    assert [episode["scene_id"] for episode in meta.episodes] == list(SCENES)
    assert [episode["outcome"] for episode in meta.episodes] == ["timeout", "timeout"]
    assert meta.tasks.index.tolist() == ["Take the cracker box from the person's hand."]
    for name, feature in meta.features.items():
        if name in meta.stats:
            assert np.isfinite(meta.stats[name]["q99"]).all()
        assert feature["dtype"] in ("float32", "int64", "uint8", "bool", "video")


def test_statistics_are_those_of_lerobot(out: Path) -> None:
    from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats

    dataset = load(out)
    names = [name for name in ("observation.state", "action", "observation.wrist_object_points") if name in dataset[0]]
    features = {name: dataset.features[name] for name in names}
    episodes = []
    for number in range(2):
        frames = read_frames(out, number)
        episodes.append(compute_episode_stats({name: frames[name] for name in names}, features))
    expected = aggregate_stats(episodes)
    for name in names:
        for statistic, values in expected[name].items():
            # LeRobot estimates quantiles from histograms.
            tolerance = 0.2 if statistic.startswith("q") else 1e-5
            found = dataset.meta.stats[name][statistic]
            np.testing.assert_allclose(found, values, atol=tolerance, err_msg=f"{name} {statistic}")


def test_chunks_of_actions(out: Path) -> None:
    """Chunks of consecutive actions, as policies read them, are padded at the end of an episode."""
    import torch

    dataset = load(out, episodes=[1], delta_timestamps={"action": [0.0, 1 / FPS, 2 / FPS]})
    assert len(dataset) == 6
    item = dataset[4]
    np.testing.assert_array_equal(item["action"][:2].numpy(), read_frames(out, 1)["action"][4:])
    assert item["action_is_pad"].tolist() == [False, False, True]
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=3)))
    assert batch["action"].shape == (3, 3, 9)
