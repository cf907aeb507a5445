"""Tests of the conversion to LeRobot's format; `make lerobot` installs LeRobot, without which some are skipped."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl import Demonstrations
from handover_marl.cli import main
from handover_marl.episode.observations import receiver_observation_space
from handover_marl.episode.spaces import OBS_PARTS
from handover_marl.errors import OptionError
from handover_marl.evaluation.demonstrations.convert import convert_to_lerobot, describe_features, make_columns
from handover_marl.evaluation.demonstrations.demonstration import Demonstration
from tests.evaluation.demonstrations.recording import SCENES, record
from tests.helpers.lerobot import prepare_lerobot

FPS = 10
NAME = "local/handovers"
METADATA = {"scene_id": 5, "object_name": "025_mug", "outcome": "success"}


@pytest.mark.parametrize("obs_mode", [*OBS_PARTS, "state+rgb+pointcloud"])
def test_every_observation_is_a_column(obs_mode: str) -> None:
    rng, space = np.random.default_rng(0), receiver_observation_space(obs_mode)
    observations = {key: rng.integers(0, 255, (3, *part.shape)).astype(part.dtype) for key, part in space.items()}
    flags = np.array([False, True])
    demonstration = Demonstration(
        observations=observations,
        actions=rng.normal(size=(2, 9)).astype(np.float32),
        rewards=flags.astype(float),
        terminations=flags,
        truncations=flags & False,
        steps=np.array([0, 50, 90]),
        giver_steps=np.array([40]),
        giver_actions=np.ones((1, 8), np.float32),
        metadata=METADATA,
    )
    columns = make_columns(demonstration)
    for name, feature in describe_features(columns).items():
        assert columns[name].shape == (2, *feature["shape"])
        assert feature["dtype"] in (str(columns[name].dtype), "video"), name
        assert len(feature["names"] or ()) in (0, feature["shape"][0], 3)
    assert columns["next.reward"].ravel().tolist() == [0.0, 1.0]
    assert columns["next.success"].ravel().tolist() == columns["next.done"].ravel().tolist() == [False, True]
    assert columns["giver.action"][:, 0].tolist() == [0.0, 1.0]
    n_values = sum(values[0].size for values in columns.values())
    assert n_values == sum(values[0].size for values in demonstration.observations.values()) - 1 + 9 + 8 + 3
    np.testing.assert_array_equal(columns["observation.state"], demonstration.observations["robot_joint_position"][:-1])
    if obs_mode.startswith("state"):
        names = describe_features(columns)["observation.environment_state"]["names"]
        first = names.index("object_poses.0")
        poses = columns["observation.environment_state"][:, first : first + 35].reshape(2, 5, 7)
        np.testing.assert_array_equal(poses, demonstration.observations["object_poses"][:-1])


def test_decisions_have_no_frame_rate(out: Path) -> None:
    with pytest.raises(OptionError, match=r"at a constant frame rate, got 2 episodes with fps None.*--fps 20"):
        convert_to_lerobot(out, NAME)


@pytest.fixture(scope="module")
def lerobot() -> Any:
    """Import LeRobot's data sets."""
    prepare_lerobot()
    from lerobot.datasets import lerobot_dataset

    return lerobot_dataset


@pytest.mark.slow
def test_lerobot_reads_the_data_set(
    lerobot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import torch

    monkeypatch.setattr(lerobot, "HF_LEROBOT_HOME", tmp_path / "lerobot")
    ours: Demonstrations = record(tmp_path / "out", fps=FPS, obs_mode="state+rgbd+segmentation", giver="noisy")
    assert main(["convert", str(tmp_path / "out"), "--to", "lerobot", "--name", NAME]) == 0
    assert f"Data set: {tmp_path / 'lerobot' / NAME}" in capsys.readouterr().out
    dataset = lerobot.LeRobotDataset(NAME)
    assert (dataset.num_episodes, len(dataset), dataset.fps) == (2, 12, FPS)
    assert dataset.meta.robot_type == "panda"
    for number, demonstration in enumerate(ours):
        columns = make_columns(demonstration)
        for frame in range(6):
            item = dataset[6 * number + frame]
            assert item["timestamp"].item() == pytest.approx(frame / FPS)
            assert item["task"] == "Take the cracker box from the person's hand."
            for name, values in columns.items():
                if name == "observation.images.wrist":
                    expected = np.moveaxis(values[frame], -1, 0) / 255.0
                    assert np.abs(item[name].numpy() - expected).mean() < 0.03
                else:
                    found = item[name].numpy().reshape(values[frame].shape)
                    np.testing.assert_array_equal(found, values[frame], err_msg=name)
    statistics = dataset.meta.stats["action"]
    actions = np.concatenate([demonstration.actions for demonstration in ours])
    np.testing.assert_allclose(statistics["mean"], actions.mean(axis=0), rtol=1e-4, atol=1e-5)
    metadata = json.loads((tmp_path / "lerobot" / NAME / "meta" / "handover_marl.json").read_text())
    assert [(episode["scene_id"], episode["outcome"]) for episode in metadata] == [(n, "timeout") for n in SCENES]
    with pytest.raises(OptionError, match="name must be a new data set of LeRobot"):
        convert_to_lerobot(tmp_path / "out", NAME)
    # Chunks of consecutive actions, as policies read them, are padded at the end of an episode.
    part = lerobot.LeRobotDataset(NAME, episodes=[1], delta_timestamps={"action": [0.0, 1 / FPS, 2 / FPS]})
    np.testing.assert_array_equal(part[4]["action"][:2].numpy(), ours[1].actions[4:])
    assert part[4]["action_is_pad"].tolist() == [False, False, True]
    batch = next(iter(torch.utils.data.DataLoader(part, batch_size=3)))
    assert batch["action"].shape == (3, 3, 9)
