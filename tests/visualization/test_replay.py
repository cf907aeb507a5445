"""Tests of pages that replay an episode in three dimensions."""

import base64
import re
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.config import TIME_STEP, ProtocolConfig, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.kinematic_tree import compute_link_trajectory
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.receivers import make
from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.visualization.replay_recorder import FRAME_STEPS, ReplayRecorder
from handover_marl.visualization.replay_scene import (
    END_PAUSE_S,
    build_replay_page,
    compute_link_trajectories,
    compute_robot_link_poses,
)
from tests.evaluation.quick import QuickReceiver
from tests.helpers.playing import StepRecorder
from tests.helpers.short_episodes import shorten_episodes
from tests.visualization.outside import outside

viser = pytest.importorskip("viser", reason="needs the extra `replay`")
msgspec = pytest.importorskip("msgspec")
zstandard = pytest.importorskip("zstandard")
pytest.importorskip("fast_simplification", reason="needs the extra `replay`")

SHORT = WorldConfig(protocol=ProtocolConfig(horizon_steps=1300))


class Meaning(QuickReceiver):
    """Receiver that holds still, and reports a constant planned goal in front of the gripper."""

    name = "meaning"
    obs_mode = "state+pointcloud"
    control_period = 1.0
    meant = np.array([[0.6, -0.1, 1.3, 0.0, 1.0, 0.0, 0.0], [0.6, 0.0, 1.3, 0.0, 1.0, 0.0, 0.0]])

    @property
    def planned_goal(self) -> np.ndarray | None:
        return self.meant


@pytest.fixture(scope="module")
def recorded(fake_data: Path) -> tuple[ReplayRecorder, np.ndarray]:
    """Return the log of an episode, and the simulated poses of the gripper at its frames but the last."""
    data = open_dataset("dexycb", fake_data)
    seeing = StepRecorder(lambda episode: episode.observe()["gripper_pose"], FRAME_STEPS)
    episode, robot = Episode("fast", SHORT), make(Meaning, data)
    recorder = ReplayRecorder(robot)
    episode.reset(data.load_scene(14))
    run_episode(episode, robot, seed=0, callbacks=[recorder, seeing])
    assert (recorder.status, recorder.frames[-1].step) == (episode.status, episode.steps)
    episode.close()
    return recorder, np.array(seeing.rows)


@pytest.fixture
def log(recorded: tuple[ReplayRecorder, np.ndarray]) -> ReplayRecorder:
    return recorded[0]


def test_frames_and_link_poses(recorded: tuple[ReplayRecorder, np.ndarray]) -> None:
    log, gripper = recorded
    assert (log.status, log.frames[-1].step) == (EpisodeStatus.TIMEOUT, 1300)
    assert [frame.step for frame in log.frames] == [*range(0, 1300, FRAME_STEPS), 1300]
    hand = compute_robot_link_poses(log, [frame.snapshot for frame in log.frames], [HAND_LINK])[:-1, 0]
    np.testing.assert_allclose(hand[:, :3], gripper[:, :3], atol=1e-5)
    links = list(compute_link_trajectories(log))
    labels = SegmentationLabel
    assert {link.label for link in links} == {*labels} - {labels.BACKGROUND}
    target = next(link for link in links if link.label is labels.TARGET)
    objects = [frame.snapshot.objects[0] for frame in log.frames]
    origins, _ = compute_link_trajectory(log.scene.assets.objects[0], objects)
    np.testing.assert_allclose(target.poses[:, :3], origins[:, target.mesh.link])
    assert np.ptp(target.poses[:, 2]) > 0.1, "the person lifts it"
    finger = next(link for link in links if link.label is labels.HAND)
    assert finger.is_present[[0, 5]].tolist() == [False, True]


def test_clouds_and_plans_are_recorded(log: ReplayRecorder) -> None:
    assert [step for step, *_ in log.clouds] == [0, 1000]
    np.testing.assert_array_equal(log.frames[3].planned_path, Meaning.meant)
    for _, _, *clouds in log.clouds:
        assert all(cloud.shape[1] == 3 and len(cloud) <= 600 for cloud in clouds)


def read_recording(page: str) -> dict[str, Any]:
    """Return the decoded recording that viser's page plays."""
    stage = unescape(re.search(r'srcdoc="(.*?)"', page, re.DOTALL).group(1))  # type: ignore[union-attr]
    packed = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="(.*?)"', stage).group(1))  # type: ignore[union-attr]
    plain = zstandard.ZstdDecompressor().decompress(packed[8:])
    size = int.from_bytes(plain[:8], "little")
    found: dict[str, Any] = msgspec.msgpack.decode(plain[8 : 8 + size])
    assert found["viserVersion"] == viser.__version__
    return found


def texts(messages: list[Any]) -> Iterator[tuple[float, str]]:
    for time, message in messages:
        text = message.get("updates", message.get("props", {})).get("text")
        if text:
            yield time, text


def test_page_plays_in_real_time_and_loads_no_files(log: ReplayRecorder, capfd: pytest.CaptureFixture[str]) -> None:
    log.frames[20] = replace(log.frames[20], touches_hand=True)
    page = build_replay_page(log, "fake <data>")
    assert capfd.readouterr().out == ""
    assert outside(page) == []
    assert len(page.encode()) < 3_000_000
    assert "scene 14, timeout, 1300 steps" in page[:1000]
    assert "fake &lt;data&gt;" in page
    recording = read_recording(page)
    assert recording["durationSeconds"] == pytest.approx(1300 * TIME_STEP + END_PAUSE_S)
    words = list(texts(recording["messages"]))
    assert [time for time, _ in words] == pytest.approx([frame.step * TIME_STEP for frame in log.frames])
    assert words[10][1].startswith("0.40 s - ")
    assert words[-1][1] == "1.30 s - timeout"
    changes = [
        (time, message.get("updates", {}))
        for time, message in recording["messages"]
        if message.get("name") == "/hand/7"
    ]
    reddened = [time for time, updates in changes if updates.get("color") == [230, 30, 40]]
    assert reddened == pytest.approx([0.8]), "the hand is red while the robot touches it"
    assert [time for time, updates in changes if "color" in updates][-1] == pytest.approx(0.84)
    lights = [message for _, message in recording["messages"] if "HemisphereLight" in message["type"]]
    assert len(lights) == 1
    assert "canvas{opacity:1!important" in unescape(page).partition("</head>")[2].partition("</head>")[0]
    names = {message.get("name") for _, message in recording["messages"]}
    assert {"/goal", "/planned_path", "/robot/9", "/object0/6", "/object1/6", "/status"} <= names


@pytest.mark.slow
def test_render_command_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "episode.html"
    command = ["render", "--scene", "209", "--dataset", "synthetic", "--physics", "fast", "--out", str(out)]
    assert main([*command, "--view", "wrist"]) == 2
    assert "must be 'outside'" in capsys.readouterr().err
    shorten_episodes(monkeypatch, 300)
    assert main(command) == 0
    page = out.read_text()
    assert "synthetic scenes" in page
    assert "receiver hold, giver replay; fast physics" in page
    assert len(page.encode()) < 3_000_000
