"""Metrics of made-up tracks, whose values are known."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.benchmarking.fluency_tables import METRICS, fluency_averages
from handover_marl.benchmarking.playing import Job, Player, Task, play
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.fluency import Fluency, activities, fluency, spectral_arc_length
from handover_marl.episode.playback import NO_DEVIATION
from handover_marl.episode.track import Recorder, Track
from handover_marl.receivers import make
from handover_marl.sim.bullet.gap import GapMeter

PERIOD = 0.02


def ramp(start: float, end: float, duration: float, way: float) -> np.ndarray:
    """(n, 3) places of something that goes `way` m along x between two times."""
    times = np.arange(PERIOD, duration + PERIOD / 2, PERIOD)
    x = np.interp(times, [start, end], [0.0, way])
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)


def made_up(**changes: object) -> Track:
    """The person moves from 1 to 2 s, the robot from 3 to 4.5 s and takes the object at 4 s of 5 s."""
    wrist = ramp(1.0, 2.0, 5.0, 0.5)
    track = Track(PERIOD, ramp(3.0, 4.5, 5.0, 0.6), np.zeros((len(wrist), 2)), wrist, 5.0, 4.0, 12.0, 0.03)
    return dataclasses.replace(track, **changes)  # type: ignore[arg-type]


def test_a_handover_one_after_the_other() -> None:
    found = fluency(made_up())
    assert found.handover_time == 4.0
    assert found.human_idle == pytest.approx(0.8, abs=0.02)
    assert found.robot_idle == pytest.approx(0.7, abs=0.02)
    assert found.concurrent == 0.0
    assert found.functional_delay == pytest.approx(1.0 / 5.0, abs=0.02)
    assert (found.peak_force, found.min_distance) == (12.0, 0.03)
    assert found.giver_path == pytest.approx(0.5, abs=1e-6)
    assert found.reach == pytest.approx(0.5, abs=1e-6)


def test_a_robot_that_comes_while_the_person_moves_has_a_negative_delay() -> None:
    found = fluency(made_up(gripper=ramp(1.5, 4.2, 5.0, 0.6)))
    assert found.functional_delay == pytest.approx(-0.5 / 5.0, abs=0.02)
    assert found.concurrent == pytest.approx(0.5 / 5.0, abs=0.02)


def test_closing_fingers_are_activity() -> None:
    fingers = np.repeat(ramp(3.0, 3.5, 5.0, -0.03)[:, :1], 2, axis=1)
    still = np.zeros_like(made_up().gripper)
    assert fluency(made_up(gripper=still, fingers=fingers)).robot_idle == pytest.approx(0.9, abs=0.02)


def test_nothing_to_tell() -> None:
    """No release and no hand: nothing is made up."""
    track = made_up()
    found = fluency(dataclasses.replace(track, wrist=np.full_like(track.wrist, np.nan), release=None, gap=None))
    assert found.handover_time is found.functional_delay is found.giver_smoothness is found.min_distance is None
    assert (found.human_idle, found.giver_path, found.reach) == (1.0, 0.0, 0.0)


def test_pauses_divide_activities_only_when_long() -> None:
    active = np.zeros(100, dtype=bool)
    active[[10, 11, 20, 21, 60]] = True
    assert activities(active, 0.02) == [(10, 21), (60, 60)]


def minimum_jerk(duration: float) -> np.ndarray:
    t = np.arange(0.0, 1.0, PERIOD / duration)
    return 30.0 * (t**2 - 2.0 * t**3 + t**4) / duration


def test_smoothness_is_as_published() -> None:
    """A single minimum-jerk movement has a spectral arc length of -1.41 (Balasubramanian et al., 2015)."""
    smooth = spectral_arc_length(minimum_jerk(1.0), 1.0 / PERIOD)
    assert smooth == pytest.approx(-1.41, abs=0.02)
    twice = np.concatenate([minimum_jerk(0.6), np.zeros(10), minimum_jerk(0.6)])
    rough = spectral_arc_length(twice, 1.0 / PERIOD)
    assert rough is not None
    assert rough < -1.8


@given(st.floats(0.1, 10.0))
def test_smoothness_does_not_depend_on_speed(factor: float) -> None:
    speed = minimum_jerk(0.8)
    assert spectral_arc_length(factor * speed, 50.0) == pytest.approx(spectral_arc_length(speed, 50.0))


def test_gap_is_what_the_world_says() -> None:
    """In the world, where both stand, Bullet tells the same distance."""
    scene = SyntheticDataset().scene(209)
    episode = Episode("exact")
    episode.reset(scene)
    start = np.array([0.0, -1.285, 0.0, -2.356, 0.0, 1.571, 0.785, 0.04, 0.04], dtype=np.float32)
    meter = GapMeter(scene.assets.panda, scene.assets.hand)
    smallest = math.inf
    for _ in range(15):
        episode.advance(start, 100, NO_DEVIATION)
        meter.measure(episode.world.state())
        world = episode.world
        hand = getattr(world, "_hand", None)
        if hand is not None:
            points = world._client.getClosestPoints(world._panda.id, hand.id, 3.0)  # type: ignore[attr-defined]
            smallest = min(smallest, *(point[8] for point in points))
    assert math.isfinite(smallest)
    assert meter.smallest == pytest.approx(smallest, abs=1e-4)
    meter.close()
    episode.close()


@pytest.fixture(scope="module")
def played() -> Fluency:
    player = Player(Job("synthetic", None, "yang2021", "replay", "fast", "here"))
    found = player.play(Task(0, 209)).result
    player.close()
    assert found.fluency is not None
    return found.fluency


def test_a_played_scene_has_all_metrics(played: Fluency) -> None:
    assert 0.0 < played.human_idle < 1.0
    assert 0.0 < played.robot_idle < 1.0
    assert played.peak_force > 0.0
    assert played.min_distance is not None
    assert played.giver_path >= played.reach > 0.1


def test_recording_changes_nothing() -> None:
    dataset = SyntheticDataset()
    episode, policy, scene = Episode("exact"), make("yang2021", dataset), dataset.scene(209)
    plain, _ = play(episode, scene, policy)
    recorded, _ = play(episode, scene, policy, None, Recorder(scene))
    np.testing.assert_array_equal(plain, recorded)


def test_every_metric_has_a_column() -> None:
    assert [metric.key for metric in METRICS] == [part.name for part in dataclasses.fields(Fluency)]
    assert fluency_averages([]) == {}
