"""Tests that receivers, fed with recorded frames as a driver of a robot does, act as in the simulation."""

import re
from pathlib import Path

import pytest

import handover_marl
from handover_marl import receivers
from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.loop import derive_receiver_seed
from tests.docs.pages import REPOSITORY, checked_table

PAGE = REPOSITORY / "docs" / "how_to" / "real_robot.md"
#: Keys of the observation that each receiver uses, as the page lists them.
KEYS = {row[0].strip("`"): set(re.findall(r"`(\w+)`", row[1])) for row in checked_table(PAGE, "driver inputs")}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "obs_mode"), [("reactive", "state"), ("vision", "scene_pointcloud")])
def test_recorded_frames_give_the_actions_of_the_simulation(name: str, obs_mode: str, tmp_path: Path) -> None:
    """The receiver gets nothing but the listed keys, and acts whenever its hold time has passed, to the byte."""
    if name == "vision":
        pytest.importorskip("embreex", reason="needs the extra `vision`")
        pytest.importorskip("torch", reason="needs the extra `train`")
    robot = "panda_camera" if name == "vision" else "panda"
    short = ProtocolConfig(horizon_steps=3700 if name == "vision" else 3000)  # until the fingers begin to close
    (episode,) = handover_marl.demonstrate(
        *("s0", "train", name),
        **{"obs_mode": obs_mode, "dataset": "synthetic", "physics": "fast", "robot": robot, "scenes": [105]},
        **{"out": tmp_path, "workers": 1, "progress": False, "world_config": WorldConfig(protocol=short)},
    )
    receiver = receivers.make(name, open_dataset("synthetic", robot=robot))
    receiver.prepare([episode.metadata["object_name"]])
    first = {key: values[0] for key, values in episode.observations.items()}
    receiver.reset(derive_receiver_seed(0, first))
    step = 0
    for row, action in enumerate(episode.actions):
        assert episode.steps[row] == step
        observation = {key: episode.observations[key][row] for key in KEYS[name]}
        assert receiver.act(observation).tobytes() == action.tobytes(), f"{name} acts differently in row {row}"
        step += round(1000 * receiver.hold_time)
    assert episode.actions[:, 7].min() == 0.0, "no fingers close, so that the approach alone is tested"
