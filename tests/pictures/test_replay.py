"""Episodes as pages that play them in three dimensions."""

import base64
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.cli import main
from handover_marl.config import TIME_STEP
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.watchers import Watcher
from handover_marl.models.motion_frames import motion_frames
from handover_marl.models.panda import HAND_LINK
from handover_marl.models.visual_meshes import read_visual_meshes
from handover_marl.pictures.replay_bodies import moving_links, nearest_place, robot_links, small_meshes
from handover_marl.pictures.replay_page import replay_page
from handover_marl.pictures.replay_recorder import MOMENT_STEPS, EpisodeLog, ReplayRecorder
from handover_marl.pictures.replay_stage import END_STAYS
from handover_marl.pictures.replay_words import events_of, words_of
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.receivers import Receiver, make
from handover_marl.sim.camera.photo import Seen
from tests.benchmarking.quick import SHORT, QuickReceiver
from tests.pages.outside import outside

viser = pytest.importorskip("viser", reason="needs the extra `replay`")
msgspec = pytest.importorskip("msgspec")
zstandard = pytest.importorskip("zstandard")
pytest.importorskip("fast_simplification", reason="needs the extra `replay`")


class Meaning(QuickReceiver):
    """Holds still, and says that it means to go to a place in front of it."""

    name = "meaning"
    sight = "points"
    meant = np.array([[0.6, -0.1, 1.3, 0.0, 1.0, 0.0, 0.0], [0.6, 0.0, 1.3, 0.0, 1.0, 0.0, 0.0]])

    @property
    def intention(self) -> np.ndarray | None:
        return self.meant


class Seeing(Watcher):
    """Keeps the true place of the gripper at every moment."""

    def started(self, episode: Episode) -> None:
        self.gripper = [episode.observe()["gripper_pose"]]

    def stepped(self, episode: Episode) -> None:
        if episode.steps % MOMENT_STEPS == 0:
            self.gripper.append(episode.observe()["gripper_pose"])


def recorded(fake_data: Path, receiver: type[Receiver], *more: Watcher, scene: int = 14) -> tuple[EpisodeLog, Any]:
    data = open_dataset("dexycb", fake_data)
    episode, robot = Episode("fast", SHORT), make(receiver, data)
    recorder = ReplayRecorder(robot)
    episode.reset(data.scene(scene))
    play(episode, robot, seed=0, watchers=[recorder, *more])
    ended = episode.status, episode.steps, episode.world.snapshot()
    episode.close()
    return recorder.log, ended


@pytest.fixture(scope="module")
def log(fake_data: Path) -> EpisodeLog:
    return recorded(fake_data, Meaning)[0]


def test_moments_from_start_to_end_and_links_where_they_were(fake_data: Path) -> None:
    seeing = Seeing()
    log, (status, steps, _) = recorded(fake_data, QuickReceiver, seeing)
    assert (log.status, log.moments[-1].step) == (status, steps) == (EpisodeStatus.TIMEOUT, 1300)
    assert [moment.step for moment in log.moments] == [*range(0, 1300, MOMENT_STEPS), 1300]
    hand = robot_links(log, [moment.joints for moment in log.moments], [HAND_LINK])[:-1, 0]
    np.testing.assert_allclose(hand[:, :3], np.array(seeing.gripper)[:, :3], atol=1e-5)
    links = {link.name: link for link in moving_links(log)}
    assert {Seen.TABLE, Seen.ROBOT, Seen.TARGET, Seen.OTHER_OBJECT, Seen.HAND} == {link.seen for link in links.values()}
    target = next(link for link in links.values() if link.seen is Seen.TARGET)
    frames = motion_frames(log.scene.assets.objects[0], [moment.joints.objects[0] for moment in log.moments])
    np.testing.assert_allclose(target.poses[:, :3], frames.origins[:, target.mesh.link])
    assert np.ptp(target.poses[:, 2]) > 0.1, "the person lifts it"
    fingers = [link for link in links.values() if link.seen is Seen.HAND]
    assert not fingers[0].there[0]
    assert fingers[0].there[5]


class Ends(Watcher):
    def ended(self, episode: Episode) -> None:
        self.end = episode.status, episode.steps, episode.world.snapshot()


def test_recording_changes_nothing(fake_data: Path) -> None:
    data = open_dataset("dexycb", fake_data)
    ends = []
    for watched in (False, True):
        episode, robot, end = Episode("fast", SHORT), make("random", data), Ends()
        episode.reset(data.scene(9))
        play(episode, robot, seed=3, watchers=[ReplayRecorder(robot), end] if watched else [end])
        ends.append(end.end)
        episode.close()
    assert ends[0][:2] == ends[1][:2]
    for one, other in zip(ends[0][2], ends[1][2], strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_a_receiver_sees_and_means_is_noted(log: EpisodeLog) -> None:
    assert [cloud.step for cloud in log.clouds] == [0, 1000]
    np.testing.assert_array_equal(log.moments[3].intended, Meaning.meant)
    for cloud in log.clouds:
        assert cloud.object_points.shape[1] == cloud.hand_points.shape[1] == 3
        assert max(len(cloud.object_points), len(cloud.hand_points)) <= 600


@pytest.mark.parametrize("model", ["panda", "hand"])
def test_small_meshes_look_like_large_ones(fake_data: Path, model: str) -> None:
    from handover_marl.models.kinematic_tree import read_tree

    urdf = getattr(open_dataset("dexycb", fake_data).scene(9).assets, model)
    large = {part.link: part for part in read_visual_meshes(urdf, read_tree(urdf))}
    small = {part.link: part for part in small_meshes(urdf, 0)}
    assert large.keys() == small.keys()
    for link, part in small.items():
        assert len(part.faces) <= 900
        assert part.faces.max() < len(part.vertices)
        for end in (np.min, np.max):
            np.testing.assert_allclose(end(part.vertices, axis=0), end(large[link].vertices, axis=0), atol=0.004)


def told(page: str) -> dict[str, Any]:
    """What viser's page plays."""
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


def test_the_page_plays_in_real_time_and_loads_nothing(log: EpisodeLog, capfd: pytest.CaptureFixture[str]) -> None:
    page = replay_page(log, "fake <data>")
    assert capfd.readouterr().out == ""
    assert outside(page) == []
    assert len(page.encode()) < 3_000_000
    assert "scene 14, timeout, 1300 steps" in page[:1000]
    assert "fake &lt;data&gt;" in page
    recording = told(page)
    assert recording["durationSeconds"] == pytest.approx(1300 * TIME_STEP + END_STAYS)
    words = list(texts(recording["messages"]))
    assert [time for time, _ in words] == pytest.approx([moment.step * TIME_STEP for moment in log.moments])
    assert words[10][1].startswith("0.40 s - ")
    assert words[-1][1] == "1.30 s - timeout"
    names = {message.get("name") for _, message in recording["messages"]}
    assert {"/goal", "/intention", "/robot/9", "/object0/6", "/object1/6", "/words"} <= names


def moved(log: EpisodeLog, number: int, **changes: Any) -> EpisodeLog:
    from dataclasses import replace

    moments = [replace(m, **changes) if k == number else m for k, m in enumerate(log.moments)]
    return replace(log, moments=tuple(moments), release=Release.ACTIVE, release_step=413, status=EpisodeStatus(2))


def test_words_and_events(log: EpisodeLog) -> None:
    point = np.zeros((1, 3), dtype=np.float32)
    other = moved(log, 9, on_object=True, finger_points=(point, point), on_hand=True)
    assert words_of(other, other.moments[9]) == "0.36 s - held out - robot on hand - both fingers on object"
    assert words_of(other, other.moments[-1]).endswith(" s - contact")
    events = {words: at for at, words in events_of(other)}
    assert events["both fingers are on the object"] == pytest.approx(0.36)
    assert events["the person lets go of what the fingers hold"] == pytest.approx(0.413)
    assert events["contact"] == pytest.approx(1.3)
    assert [at for at, _ in events_of(other)] == sorted(at for at, _ in events_of(other))


def test_where_the_robot_is_nearest_to_the_hand(log: EpisodeLog) -> None:
    links = list(moving_links(log))
    assert nearest_place(links, Seen.ROBOT, Seen.HAND, 0) is None
    place = nearest_place(links, Seen.ROBOT, Seen.HAND, 5)
    back = nearest_place(links, Seen.HAND, Seen.ROBOT, 5)
    assert place is not None
    assert back is not None
    assert np.linalg.norm(place - back) < 1.0
    assert np.linalg.norm(back - log.moments[5].joints.hand[:3]) < 0.25


@pytest.mark.slow
def test_the_command_line_makes_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "episode.html"
    command = ["render", "--scene", "209", "--dataset", "synthetic", "--physics", "fast", "--out", str(out)]
    assert main([*command, "--view", "wrist"]) == 2
    assert "from outside" in capsys.readouterr().err
    assert main(command) == 0
    page = out.read_text()
    assert "synthetic scenes" in page
    assert "receiver hold, giver replay; fast physics" in page
    assert len(page.encode()) < 3_000_000
