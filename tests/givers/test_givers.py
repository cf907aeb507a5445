"""Tests of the requirements on all givers, and of the behavior of each giver."""

import json
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from handover_marl import givers
from handover_marl.config import PandaConfig
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError
from handover_marl.givers import Giver

START = np.array(PandaConfig().start_joints, dtype=np.float32)


def seen(**changes: Any) -> Observation:
    """Return an observation of a hand that holds out an object, with the gripper 0.6 m away."""
    pose = np.array([0.6, 0.3, 1.2, 0, 0, 0, 1], dtype=np.float32)
    wrist = pose + np.float32([0, 0.1, 0, 0, 0, 0, 0])
    observation = {
        "time": np.float32([1.0]),
        "gripper_pose": np.float32([0.6, -0.3, 1.2, 0, 0, 0, 1]),
        "robot_joint_position": START,
        "robot_joint_velocity": np.zeros(9, dtype=np.float32),
        "object_poses": np.tile(pose, (5, 1)),
        "object_classes": np.float32([2, 0, 0, 0, 0]),
        "hand_keypoints": np.tile(wrist[:3], (16, 1)),
        "hand_present": np.float32([1]),
        "released": np.float32([0]),
        "replay_wrist_poses": np.tile(wrist, (5, 1)),
        "replay_object_poses": np.tile(pose, (5, 1)),
        "deviation": np.zeros(7, dtype=np.float32),
        "holding": np.float32([1]),
    }
    return observation | changes


def make(name: str, seed: int = 0) -> Giver:
    giver = givers.make(name)
    giver.reset(seed)
    return giver


@pytest.mark.parametrize("name", ["hesitant", "hurried", "noisy", "displaced", "tired", "recording_spread"])
def test_actions_depend_on_the_seed(name: str) -> None:
    """`tests/test_testing.py` checks that they repeat from it."""
    first, other = (make(name, seed) for seed in (1, 2))
    times = 0.1 * np.arange(40, dtype=np.float32)
    actions = [[giver.act(seen(time=times[[n]])) for n in range(40)] for giver in (first, other)]
    assert not np.array_equal(*actions)


def test_hesitant_people_pause_and_go_on() -> None:
    giver = make("hesitant")
    rates = [giver.act(seen(time=np.float32([0.1 * n])))[0] for n in range(130)]
    assert set(rates) == {-1.0, 0.0}
    assert 0.1 < np.mean(np.array(rates) == -1.0) < 0.6


def test_noise_has_the_size_it_says() -> None:
    giver = make("noisy")
    actions = np.array([giver.act(seen()) for _ in range(4000)])
    np.testing.assert_allclose(actions[:, 1:4].std(axis=0), 0.02, rtol=0.2)
    np.testing.assert_allclose(actions[:, 4:7].std(axis=0), 0.1, rtol=0.2)


def test_displacements_are_as_large_as_said_and_constant_in_an_episode() -> None:
    giver = givers.make("displaced:distance=0.1,angle=0.3")
    deviations = []
    for seed in range(400):
        giver.reset(seed)
        action = giver.act(seen())
        np.testing.assert_array_equal(giver.act(seen(time=np.float32([3.0]))), action)
        deviations.append(action)
    distances = np.linalg.norm(np.array(deviations)[:, 1:4], axis=1)
    angles = np.linalg.norm(np.array(deviations)[:, 4:7], axis=1)
    assert 0.099 < distances.max() <= 0.1 + 1e-7
    assert 0.29 < angles.max() <= 0.3 + 1e-7
    # Half of the volume of a ball is within 0.79 of its radius.
    assert np.median(distances) == pytest.approx(0.1 * 0.5 ** (1 / 3), rel=0.05)
    assert np.median(angles) == pytest.approx(0.15, rel=0.15)


def test_a_tired_hand_trembles_and_sinks_while_it_holds_the_object() -> None:
    giver = givers.make("tired:amplitude=0.002,frequency=4,sinking=0.05,max_sinking=0.02")
    giver.reset(0)
    times = np.arange(1.0, 3.0, giver.control_period)
    before = np.array([giver.act(seen(time=np.float32([t]), holding=np.float32([0])))[1:4] for t in times])
    after = np.array([giver.act(seen(time=np.float32([t + 2.0])))[1:4] for t in times])
    for sway in (before, after - before):
        assert np.abs(sway[:, :2]).max() <= 0.002 + 1e-6
    np.testing.assert_allclose(np.abs(before).max(axis=0), 0.002, rtol=0.05)
    # The tremor of 4 Hz repeats every 0.25 s, so the differences are the sinking of the hand.
    np.testing.assert_allclose((after - before)[:, 2], -np.minimum(0.05 * (times - 1.0), 0.02), atol=1e-5)
    crossings = np.count_nonzero(np.diff(np.sign(before[:, 0])))
    assert crossings == pytest.approx(2 * 4 * 2.0, abs=1)


def test_an_early_release_follows_the_gripper_after_a_delay() -> None:
    delays = []
    for seed in range(30):
        giver = givers.make("early_release:max_delay=0.4")
        giver.reset(seed)
        assert not any(giver.act(seen(time=np.float32([t])))[7] for t in np.arange(0.0, 5.0, 0.5)), "the gripper is far"
        # The gripper points along z of its frame, so that its fingertips are above it.
        near = np.float32([0.6, 0.3, 1.05, 0, 0, 0, 1])
        times = 5.0 + 0.02 * np.arange(30)
        releases = [giver.act(seen(time=np.float32([t]), gripper_pose=near))[7] for t in times]
        assert releases == sorted(releases)
        delays.append(times[releases.index(1.0)] - 5.0)
    assert 0.0 <= min(delays) < 0.05
    assert 0.35 < max(delays) <= 0.42
    giver.reset(0)
    unheld = seen(gripper_pose=near, holding=np.float32([0]))
    assert giver.act(unheld)[7] == giver.act(unheld | {"time": np.float32([9.0])})[7] == 0.0


@pytest.mark.parametrize(
    "text",
    [
        *("hurried:min_rate=0.9,max_rate=0.5", "displaced:distance=0.4", "tired:frequency=20"),
        *("early_release:max_delay=-1", "interrupting:longest=20", "recording_spread:rotation=4"),
    ],
)
def test_options_out_of_range(text: str) -> None:
    with pytest.raises(OptionError, match=r"must be (a finite number from|at most)"):
        givers.make(text)


def test_interruptions_withdraw_the_hand_for_a_while() -> None:
    giver = make("interrupting:interruptions_per_second=0.5,withdrawal=0.1,shortest=0.4,longest=0.8")
    away = []
    for n in range(1300):
        action = giver.act(seen(time=np.float32([0.1 * n])))
        away.append(bool(action[1:4].any()))
        if away[-1]:
            # The object is away from the gripper along y.
            np.testing.assert_allclose(action[1:4], [0.0, 0.1, 0.0], atol=1e-6)
    assert 0.1 < np.mean(away) < 0.4
    lengths = [len(part) for part in "".join("1" if each else "0" for each in away).split("0") if part]
    assert min(lengths) >= 4
    giver.reset(0)
    for state in ({"holding": np.float32([0])}, {"released": np.float32([1])}):
        assert not any(giver.act(seen(time=np.float32([0.1 * n]), **state))[1:4].any() for n in range(300))


def test_deviations_are_those_between_recordings_of_the_object() -> None:
    giver = givers.make("recording_spread")
    actions = []
    for seed in range(600):
        giver.reset(seed)
        actions.append(giver.act(seen()))
        np.testing.assert_array_equal(giver.act(seen(time=np.float32([3.0]))), actions[-1])
    spread = json.loads((files(givers) / "recording_spread.json").read_text())["objects"]["003_cracker_box"]
    deviations = np.std(actions, axis=0)
    np.testing.assert_allclose(deviations[1:4], spread["displacement"], rtol=0.12)
    np.testing.assert_allclose(deviations[4:7], spread["rotation"], rtol=0.12)
    assert np.std(np.log1p(np.array(actions)[:, 0])) == pytest.approx(spread["log_pace"], rel=0.12)


def test_stopping_when_near() -> None:
    giver = make("stop_when_near")
    assert giver.act(seen())[0] == 0.0
    near = np.float32([0.6, 0.1, 1.2, 0, 0, 0, 1])
    assert giver.act(seen(gripper_pose=near))[0] == -1.0
    assert giver.act(seen())[0] == 0.0


@pytest.mark.parametrize("start", range(10, 60, 7))
def test_hands_withdraw_for_a_time_from_what_comes_fast(start: int) -> None:
    def after(closing: float) -> np.ndarray:
        giver, times = make("withdrawing"), np.float32(0.1 * (start + np.arange(10)))
        giver.act(seen(gripper_pose=np.float32([0.6, 0.05 - 0.1 * closing, 1.2, 0, 0, 0, 1])))
        near = np.float32([0.6, 0.05, 1.2, 0, 0, 0, 1])
        return np.array([giver.act(seen(gripper_pose=near, time=times[[n]]))[1:4] for n in range(10)])

    assert not after(0.1).any()
    np.testing.assert_allclose(after(0.6), [[0.0, 0.15, 0.0]] * 8 + [[0.0, 0.0, 0.0]] * 2, atol=1e-6)


def test_cooperation_comes_towards_the_robot_and_turns_the_object_to_the_gripper() -> None:
    coming = np.linspace([0.6, 0.6, 1.2, 0, 0, 0, 1], [0.6, 0.4, 1.2, 0, 0, 0, 1], 5).astype(np.float32)
    action = make("cooperative").act(seen(replay_wrist_poses=coming))
    np.testing.assert_allclose(action[1:4], [0.0, -0.15, 0.0], atol=1e-6)
    np.testing.assert_allclose(action[4:7], np.zeros(3), atol=1e-6)
    coming[3:] = 0.0  # the recorded hand leaves
    assert not make("cooperative").act(seen(replay_wrist_poses=coming))[1:7].any()
    # A hand beside the object swings behind it.
    beside = np.float32([0.7, 0.3, 1.2, 0, 0, 0, 1])
    action = make("cooperative").act(seen(replay_wrist_poses=np.tile(beside, (5, 1))))
    np.testing.assert_allclose(action[4:7], [0.0, 0.0, 0.8], atol=1e-6)


@pytest.mark.parametrize("start", range(0, 60, 7))
def test_cooperation_lets_go_of_what_is_held_firmly_and_draws_back(start: int) -> None:
    giver = make("cooperative")
    near, gripping = np.float32([0.6, 0.2, 1.2, 0, 0, 0, 1]), START.copy()
    gripping[7:] = 0.02
    times = np.float32(0.1 * (start + np.arange(4)))[:, None]
    releases = [giver.act(seen(gripper_pose=near, robot_joint_position=gripping, time=time))[7] for time in times]
    assert releases == [0, 0, 1, 1]
    away = giver.act(seen(gripper_pose=near, released=np.float32([1])))
    assert away[2] == pytest.approx(0.15, abs=1e-6)
