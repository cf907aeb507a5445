"""Tests of the fluency metrics on constructed traces with known values, and of the recorders of traces and actions."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP, ProtocolConfig, WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.metrics import motion
from handover_marl.episode.metrics.fluency import compute_fluency, has_early_grab
from handover_marl.episode.metrics.motion import (
    SAMPLE_STEPS,
    EpisodeTrace,
    TraceRecorder,
    compute_protective_distances,
    compute_rms_jerk,
    compute_spectral_arc_length,
)
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.geometry.kinematic_tree import compute_link_trajectory
from handover_marl.receivers import make
from handover_marl.simulation.camera.images import JointSnapshot
from handover_marl.simulation.mujoco.clearance_monitor import ClearanceMonitor
from handover_marl.simulation.world import Contacts
from tests.helpers.playing import StepRecorder, play

PERIOD = SAMPLE_STEPS * TIME_STEP
N = 251  # samples in 5 s, including the one at the start


def exactly(value: float) -> object:
    """Return an expected value that allows for rounding errors only."""
    return pytest.approx(value, abs=1e-9, rel=0.0)


def ramp(start: float, end: float, duration: float, way: float) -> np.ndarray:
    """Return positions (n, 3) from time 0 on of a point that moves by `way` (m) along x between two times (s)."""
    times = PERIOD * np.arange(round(duration / PERIOD) + 1)
    x = np.interp(times, [start, end], [0.0, way])
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)


def made_up(**changes: object) -> EpisodeTrace:
    """Return a trace of 5 s: the person moves from 1 to 2 s, the robot from 3 to 4.5 s, the release is at 4 s."""
    wrist = ramp(1.0, 2.0, 5.0, 0.5)
    forces = np.full((len(wrist), 2), 12.0)
    trace = EpisodeTrace(ramp(3.0, 4.5, 5.0, 0.6), np.zeros((len(wrist), 2)), wrist, 5000, 4000, forces, 0.03)
    return dataclasses.replace(trace, **changes)  # type: ignore[arg-type]


def test_a_handover_one_after_the_other() -> None:
    """A ramp is also active one sample before and after it, because speeds are averaged over three samples."""
    found = compute_fluency(made_up())
    assert found.handover_time == exactly(4.0)
    assert found.human_idle == exactly(1.0 - 53 / N)  # active from 0.98 to 2.02 s, samples 49 to 101
    assert found.robot_idle == exactly(1.0 - 78 / N)  # from 2.98 to 4.52 s, samples 149 to 226
    assert found.concurrent == 0.0
    assert found.functional_delay == exactly((2.98 - 2.02) / 5.0)
    assert (found.max_robot_object_force, found.min_distance) == (12.0, 0.03)
    assert found.giver_path == exactly(0.5)
    assert found.reach == exactly(0.5)
    path = made_up().wrist[:201, 0]
    assert found.giver_smoothness == exactly(compute_spectral_arc_length(np.diff(path), 50.0))


def test_a_robot_that_comes_while_the_person_moves_has_a_negative_delay() -> None:
    found = compute_fluency(made_up(gripper=ramp(1.5, 4.2, 5.0, 0.6)))
    # The gripper is so slow that the sample before its ramp is not active; samples 75 to 210 are.
    assert found.functional_delay == exactly((1.5 - 2.02) / 5.0)
    assert found.concurrent == exactly(27 / N)
    assert found.robot_idle == exactly(1.0 - 136 / N)


def test_the_delay_is_between_the_last_activities_before_the_release() -> None:
    """Of two activities of each agent, the last ones count: the person's ends at 2.6 s, the robot's starts at 3.2 s."""
    wrist = ramp(0.3, 0.8, 5.0, 0.3) + ramp(2.0, 2.6, 5.0, 0.3)
    gripper = ramp(0.5, 1.0, 5.0, 0.3) + ramp(3.2, 3.8, 5.0, 0.3)
    found = compute_fluency(made_up(wrist=wrist, gripper=gripper))
    assert found.functional_delay == exactly((3.18 - 2.62) / 5.0)


@pytest.mark.slow
def test_the_margin_at_a_contact_is_that_of_the_last_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a contact the distance is 0, so that the margin is minus the protective distance at that time."""
    protective = np.array([0.3, 0.1, 0.2, 0.15])
    monkeypatch.setattr(motion, "compute_sampled_distances", lambda *motion: protective)
    monkeypatch.setattr(ClearanceMonitor, "compute_min_margin", lambda *motion: 0.5)
    scene, recorder, episode = SyntheticDataset().load_scene(209), TraceRecorder(), Episode("fast")
    episode.reset(scene)
    target = np.array(OFFICIAL_CONFIG.physics.panda.start_joints, dtype=np.float32)
    episode.advance(target, 2800)
    recorder.on_reset(episode)
    episode.advance(target, 40, on_step=[recorder.on_step])
    recorder._hand_forces.append(10.0)
    recorder.on_end(episode)
    assert recorder.trace.min_separation_margin == exactly(-0.15)
    assert (recorder.trace.min_distance, recorder.trace.max_hand_force) == (0.0, 10.0)
    assert recorder.trace.hand_impulse == exactly(10.0 * TIME_STEP)
    episode.close()


@pytest.mark.parametrize(
    ("closing", "release_step", "expected"),
    [(1.9, 4000, True), (2.1, 4000, False), (1.5, 1600, True), (0.5, None, True), (4.5, 4000, None)],
)
def test_early_grabs_close_the_fingers_before_the_offer(
    closing: float, release_step: int | None, expected: bool | None
) -> None:
    """The person offers the object at 2 s, the end of the motion; after the release, fingers do not count."""
    fingers = np.repeat(0.04 + ramp(closing, closing + 0.3, 5.0, -0.03)[:, :1], 2, axis=1)
    assert has_early_grab(made_up(fingers=fingers, release_step=release_step)) is expected
    assert has_early_grab(made_up(fingers=fingers, wrist=np.full((N, 3), np.nan))) is None


def test_closing_fingers_are_activity() -> None:
    fingers = np.repeat(ramp(3.0, 3.5, 5.0, -0.03)[:, :1], 2, axis=1)
    still = np.zeros_like(made_up().gripper)
    assert compute_fluency(made_up(gripper=still, fingers=fingers)).robot_idle == exactly(1.0 - 28 / N)


def test_the_exchange_begins_with_the_first_contact() -> None:
    found = compute_fluency(made_up(contact_step=3750, object_impulse=0.4))
    assert (found.exchange_time, found.robot_object_impulse) == (exactly(0.25), 0.4)
    assert found.gripper_contact_speed == exactly(0.4), "the speed of the ramp"
    late = compute_fluency(made_up(contact_step=4750))
    assert late.exchange_time is late.robot_object_impulse is None
    assert late.gripper_contact_speed == exactly(0.0)
    start = compute_fluency(made_up(contact_step=3019))
    assert start.gripper_contact_speed == exactly(0.2), "the average of 0, 0.2 and 0.4 at the start of the ramp"
    last = compute_fluency(made_up(contact_step=4000))
    assert (last.exchange_time, last.robot_object_impulse) == (0.0, 0.0)
    kept = compute_fluency(made_up(contact_step=3750, object_impulse=0.4, release_step=None))
    assert (kept.exchange_time, kept.robot_object_impulse) == (None, 0.4)
    never = compute_fluency(made_up())
    assert never.exchange_time is never.robot_object_impulse is never.gripper_contact_speed is None


def test_protective_distance_of_a_moving_person_and_of_a_moving_robot() -> None:
    """The person moves for 0.1 s and while the robot brakes, the robot moves for 0.1 s and brakes with 13 m/s^2."""
    found = compute_protective_distances(np.array([0.0, 1.6, 0.0, 1.6]), np.array([0.0, 0.0, 1.3, 1.3]))
    assert found == pytest.approx([0.0, 0.16, 0.13 + 0.065, 0.16 + 0.16 + 0.13 + 0.065])


def test_protective_distance_of_samples() -> None:
    """Person and robot move at 0.5 and 0.4 m/s from 1 s on; the last step has the distance of the last sample."""
    wrist, gripper = ramp(1.0, 5.0, 5.0, 2.0), ramp(1.0, 5.0, 5.0, 1.6)
    still, moving = compute_protective_distances(np.array([0.0, 0.5]), np.array([0.0, 0.4]))
    found = motion.compute_sampled_distances(wrist, gripper, N - 1)
    assert found[:49] == pytest.approx(np.full(49, still))
    assert found[52:] == pytest.approx(np.full(N - 52, moving))


def test_the_fewest_positions_with_speed_and_jerk() -> None:
    line = np.arange(13.0)[:, None] * [[0.01, 0.0, 0.0]]
    assert motion.compute_speeds(line[:2], 0.02) == pytest.approx([0.5, 0.5])
    assert motion.compute_speeds(line[:1], 0.02) == pytest.approx([0.0])
    assert compute_rms_jerk(line, PERIOD) == pytest.approx(0.0, abs=1e-6)
    assert compute_rms_jerk(line[:12], PERIOD) is None
    # Zeros are not smooth or rough; a single frequency, or two with equal amplitudes, are a point or a line.
    assert compute_spectral_arc_length(np.zeros(0), 50.0) is compute_spectral_arc_length(np.zeros(9), 50.0) is None
    assert [compute_spectral_arc_length(np.ones(1), rate) for rate in (1000.0, 160.0)] == [0.0, -1.0]


def test_pauses_up_to_a_quarter_of_a_second_do_not_divide_an_activity() -> None:
    active = np.isin(np.arange(20), [1, 2, 7, 13, 14])
    assert motion.find_activities(active, 0.05) == [(1, 7), (13, 14)]


def test_nothing_to_tell() -> None:
    """Metrics that need a release or a hand are None without them; the hand is always idle and its path is 0."""
    trace = made_up()
    found = compute_fluency(
        dataclasses.replace(trace, wrist=np.full_like(trace.wrist, np.nan), release_step=None, min_distance=None)
    )
    assert found.handover_time is found.functional_delay is found.giver_smoothness is found.min_distance is None
    assert found.min_separation_margin is found.giver_rula is None
    assert (found.human_idle, found.giver_path, found.reach) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("release_step", "seconds"), [(4000, 4.0), (4001, 4.0), (4019, 4.0), (4020, 4.02), (3999, 3.98), (3001, 3.0)]
)
def test_nothing_counts_after_the_release(release_step: int, seconds: float) -> None:
    """Path and reach of a wrist that moves at 0.5 m/s from 3 s to the end count until the release only."""
    found = compute_fluency(made_up(wrist=ramp(3.0, 5.0, 5.0, 1.0), release_step=release_step))
    assert found.giver_path == exactly(0.5 * (seconds - 3.0))
    assert found.reach == exactly(0.5 * (seconds - 3.0))
    assert found.handover_time == exactly(release_step / 1000)


def test_a_robot_that_moves_only_after_the_release_takes_nothing() -> None:
    assert compute_fluency(made_up(gripper=ramp(4.2, 4.9, 5.0, 0.6))).functional_delay is None
    late = made_up(gripper=ramp(2.9, 3.3, 5.0, 0.2) + ramp(4.2, 4.9, 5.0, 0.6))
    assert compute_fluency(late).functional_delay == exactly((2.88 - 2.02) / 5.0)


def test_a_hand_that_comes_late_goes_no_way_before() -> None:
    wrist = ramp(1.0, 2.0, 5.0, 0.5)
    wrist[:75] = np.nan  # the hand is present from 1.5 s on
    found = compute_fluency(made_up(wrist=wrist))
    assert (found.giver_path, found.reach) == (exactly(0.25), exactly(0.25))
    # Its speed is known from its second sample on, and at its first sample by averaging.
    assert found.human_idle == exactly(1.0 - 27 / N)


@pytest.mark.parametrize(("rate", "width"), [(50.0, 9), (64.0, 3)])
def test_smoothness_is_that_of_the_published_program(rate: float, width: int) -> None:
    """The spectral arc length equals that of the program published by Balasubramanian et al. (2015)."""
    speed = np.convolve(np.abs(np.random.default_rng(0).normal(size=90)), np.hanning(width), "same")
    length = 2 ** int(np.ceil(np.log2(len(speed))) + 4)
    frequency = np.arange(0, rate, rate / length)
    spectrum = np.abs(np.fft.fft(speed, length))
    spectrum = spectrum / spectrum.max()
    low = (frequency <= 10.0).nonzero()
    frequency, spectrum = frequency[low], spectrum[low]
    large = (spectrum >= 0.05).nonzero()[0]
    chosen = range(large[0], large[-1] + 1)
    frequency, spectrum = frequency[chosen], spectrum[chosen]
    steps = np.diff(frequency) / (frequency[-1] - frequency[0])
    expected = -np.sum(np.sqrt(steps**2 + np.diff(spectrum) ** 2))
    assert compute_spectral_arc_length(speed, rate) == pytest.approx(expected, rel=1e-9)


def quintic(length: float, duration: float, samples: int) -> np.ndarray:
    """Return positions (samples, 3) of a minimum-jerk movement in a direction that is not along an axis."""
    t = np.arange(samples) * PERIOD / duration
    way = length * (10.0 * t**3 - 15.0 * t**4 + 6.0 * t**5)
    return way[:, None] * np.array([2.0, -1.0, 2.0]) / 3.0


@pytest.mark.parametrize(("length", "duration"), [(0.3, 1.0), (0.5, 0.8), (0.3, 2.0)])
def test_jerk_of_a_minimum_jerk_movement(length: float, duration: float) -> None:
    """The jerk equals 60 A / T^3 (1 - 6 t/T + 6 (t/T)^2) for length A and duration T (Flash and Hogan, 1985)."""
    n = round(duration / PERIOD) + 1
    t = np.arange(n)[6:-6] * PERIOD / duration
    expected = 60.0 * length / duration**3 * (1.0 - 6.0 * t + 6.0 * t**2)
    found = compute_rms_jerk(quintic(length, duration, n), PERIOD)
    assert found == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-6)


def test_jerk_of_the_hand_counts_until_the_release_and_of_the_gripper_to_the_end() -> None:
    still = np.zeros((N, 3))
    late = still.copy()
    late[201:] = quintic(0.3, 1.0, 50)
    before = compute_fluency(made_up(wrist=late, gripper=late))
    assert before.giver_jerk == exactly(0.0)
    assert before.gripper_jerk == pytest.approx(compute_rms_jerk(late, PERIOD))
    assert before.gripper_jerk is not None
    assert before.gripper_jerk > 1.0
    assert compute_fluency(made_up(wrist=late, release_step=None)).giver_jerk == before.gripper_jerk
    absent = np.full_like(still, np.nan)
    absent[-12:] = 0.0
    assert compute_fluency(made_up(wrist=absent, release_step=None)).giver_jerk is None


def test_path_and_speeds_of_the_gripper() -> None:
    """A gripper that moves by 0.6 m from 3 to 4.5 s has a maximum speed of 0.4 m/s and a mean over 5 s of 0.12 m/s."""
    found = compute_fluency(made_up())
    assert found.gripper_path == exactly(0.6)
    assert found.gripper_max_speed == exactly(0.4)
    assert found.gripper_mean_speed == exactly(0.6 / 5.0)
    # An episode that ends 19 ms after its last sample has these 19 ms in its duration.
    assert compute_fluency(made_up(steps=5019)).gripper_mean_speed == exactly(0.6 / 5.019)


def robot_frames(dof: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    panda = OFFICIAL_CONFIG.physics.panda
    base = [*panda.base_position, *panda.base_orientation]
    return compute_link_trajectory(SyntheticDataset().panda_urdf, dof, base)


def test_no_time_is_missed_by_the_bounds() -> None:
    """The minimum distance and margin of a motion equal the minima of the distances measured at every sample."""
    scene, rng = SyntheticDataset().load_scene(209), np.random.default_rng(0)
    models = scene.assets.panda, scene.assets.hand, OFFICIAL_CONFIG.physics.panda
    monitor = ClearanceMonitor(*models)
    lower = np.array([-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9])
    upper = np.array([2.9, 1.8, 2.9, 0.0, 2.9, 3.7, 2.9])
    for middle in ([0.61, -0.5, 0.95], [0.4, 0.1, 1.2], [0.61, -0.2, 1.25], [0.61, -0.75, 0.95]):
        robot = np.concatenate([rng.uniform(lower, upper, (12, 7)), rng.uniform(0.0, 0.04, (12, 2))], axis=1)
        robot = np.concatenate([robot[:-1] + share * np.diff(robot, axis=0) for share in (0.0, 0.1, 0.5)])
        hand = np.tile(scene.hand_dof[np.flatnonzero(scene.is_hand_present(np.arange(scene.n_frames)))[0]], (33, 1))
        hand = hand.astype(np.float64)
        hand[:, :3] = rng.normal(middle, 0.2, (33, 3))
        hand[:, 3:6] = rng.uniform(-np.pi, np.pi, (33, 3))
        measured = [max(0.0, monitor.measure(row, dof, 3.0)) for row, dof in zip(robot, hand, strict=True)]
        for chosen in (slice(None), slice(0, 5), slice(5, 20), np.argsort(measured)[3:]):
            frames = robot_frames(robot[chosen]), compute_link_trajectory(scene.assets.hand, hand[chosen])
            found = monitor.compute_min_margin(robot[chosen], hand[chosen], *frames)
            distances = np.array(measured)[chosen]
            assert found == pytest.approx(np.min(distances), abs=1e-4)
            required = rng.uniform(0.0, 0.3, len(distances))
            margin = monitor.compute_min_margin(robot[chosen], hand[chosen], *frames, required)
            assert margin == pytest.approx(np.min(distances - required), abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["fast", "mujoco", "exact"])
def test_every_engine_measures_the_force_on_the_person(physics: str) -> None:
    """A contact ends the episode, so that the impulse is that of one step of 1 ms."""
    dataset, recorder, episode = SyntheticDataset(), TraceRecorder(), Episode(physics)
    play(episode, dataset.load_scene(19), make("yang2021:wait=0", dataset), None, recorder)
    assert episode.status is EpisodeStatus.HUMAN_CONTACT
    found = compute_fluency(recorder.trace)
    assert found.max_robot_hand_force == episode.contacts.robot_hand_force
    assert found.max_robot_hand_force is not None
    assert found.max_robot_hand_force > 1.0
    assert found.robot_hand_impulse == pytest.approx(TIME_STEP * found.max_robot_hand_force)
    if physics != "mujoco":
        client, world = episode.world._client, episode.world  # type: ignore[attr-defined]
        hand = [world._hand.id] if physics == "exact" else world._hand.bodies  # type: ignore[attr-defined]
        points = client.getContactPoints(world._loaded_workcell.panda.id)  # type: ignore[attr-defined]
        force = sum(point[9] for point in points if point[2] in hand)
        assert found.max_robot_hand_force == pytest.approx(force)
    episode.close()


class PushedEpisode:
    """Stub of an episode whose contacts are set by a test."""

    contacts, steps = Contacts(), 1
    release_step: int | None = None

    @property
    def world(self) -> "PushedEpisode":
        return self

    def read_joint_snapshot(self) -> JointSnapshot:
        return JointSnapshot(np.zeros(9, dtype=np.float32), None, np.zeros((1, 6), dtype=np.float32))


def test_the_impulse_on_the_object_ends_with_the_release() -> None:
    recorder, episode = TraceRecorder(), PushedEpisode()
    recorder.on_reset(episode)  # type: ignore[arg-type]
    for episode.steps, force in enumerate([0.0, 0.5, 0.0, 0.4, 0.7], start=1):
        episode.release_step = 4 if episode.steps >= 4 else None
        touches = {"robot_touches_object": force > 0.0, "robot_touches_hand": force > 0.5}
        episode.contacts = Contacts(robot_object_force=force, robot_hand_force=2.0 * force, **touches)
        recorder.on_step(episode)  # type: ignore[arg-type]
    assert recorder._contact_step == 2
    assert recorder._object_impulse == pytest.approx(0.0009)
    assert (max(recorder._forces), recorder._hand_forces) == ((0.7, 1.4), [1.4])


@pytest.mark.slow
def test_recording_changes_nothing_and_notes_what_can_be_seen() -> None:
    dataset = SyntheticDataset()
    episode, policy, scene = Episode("fast"), make("yang2021:wait=0", dataset), dataset.load_scene(9)
    recorder, sketch = TraceRecorder(), StepRecorder(Episode.observe, SAMPLE_STEPS)
    short = Episode("fast", WorldConfig(protocol=ProtocolConfig(horizon_steps=1200)))
    recorded, _ = play(episode, scene, policy, None, recorder, sketch)
    np.testing.assert_array_equal(play(short, scene, policy)[0], recorded[:1200])
    trace = recorder.trace
    assert (trace.steps, trace.release_step) == (episode.steps, episode.release_step)
    assert len(trace.gripper) == len(trace.wrist) == len(trace.fingers) == episode.steps // 20 + 1 == len(sketch.rows)
    there = np.array([bool(seen["hand_present"][0]) for seen in sketch.rows])
    np.testing.assert_array_equal(np.isnan(trace.wrist).all(axis=1), ~there)
    for key, found, expected in (
        ("gripper", trace.gripper, [seen["gripper_pose"][:3] for seen in sketch.rows]),
        ("fingers", trace.fingers, [seen["robot_joint_position"][7:] for seen in sketch.rows]),
        ("wrist", trace.wrist[there], [seen["hand_keypoints"][0] for seen in sketch.rows if seen["hand_present"][0]]),
    ):
        np.testing.assert_allclose(found, np.array(expected), atol=1e-5, err_msg=key)
    played: Any = compute_fluency(trace)
    assert 0.0 < played.human_idle < 1.0
    assert 0.0 < played.robot_idle < 1.0
    assert played.max_robot_hand_force is played.robot_hand_impulse is None, "no contact"
    others = dataclasses.asdict(played) | {"max_robot_hand_force": 1.0, "robot_hand_impulse": 1.0}
    assert None not in others.values()
    assert played.exchange_time >= 0.099, "the rules ask for contacts in 100 steps"
    assert played.gripper_contact_speed < played.gripper_max_speed
    assert played.min_separation_margin <= played.min_distance
    episode.close()
