"""The planner as a receiver."""

import logging
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl import parallel_env, receivers
from handover_marl.benchmarking.runner import benchmark
from handover_marl.datasets import Dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.clock import PolicyClock
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.models.motion_frames import motion_frames
from handover_marl.models.panda import HAND_LINK
from handover_marl.models.poses import compose_point
from handover_marl.pictures.plan_picture import render_plan
from handover_marl.receivers import WAITING_JOINTS
from handover_marl.receivers.omg import OmgReceiver, _steady

SCENE = 5
DATA = SyntheticDataset()


def omg(name: str = "omg", dataset: Dataset = DATA) -> OmgReceiver:
    receiver = receivers.make(name, dataset)
    assert isinstance(receiver, OmgReceiver)
    receiver.reset()
    return receiver


@pytest.fixture(scope="module")
def offered() -> Observation:
    """What there is to see when it is time to plan."""
    episode = Episode("fast")
    episode.reset(DATA.scene(SCENE))
    episode.advance(np.array(WAITING_JOINTS, dtype=np.float32), 3000)
    observation = episode.observe()
    episode.close()
    return observation


def at(observation: Observation, milliseconds: int) -> Observation:
    return {**observation, "time": np.array([milliseconds / 1000.0], dtype=np.float32)}


def test_commands_in_their_time(offered: Observation) -> None:
    receiver = omg()
    np.testing.assert_array_equal(receiver.act(at(offered, 0)), np.float32(WAITING_JOINTS))
    assert receiver.hold_time == 3.0
    assert receiver.plan is None
    first = receiver.act(at(offered, 3000))
    plan = receiver.plan
    assert plan is not None
    assert receiver.hold_time == 0.13
    np.testing.assert_array_equal(first, np.float32([*plan.trajectory[0], 0.04, 0.04]))
    np.testing.assert_array_equal(receiver.act(at(offered, 3129)), first)
    for number in (1, 17, 29):
        action = receiver.act(at(offered, 3000 + 130 * number))
        np.testing.assert_array_equal(action, np.float32([*plan.trajectory[number], 0.04, 0.04]))
    closed = receiver.act(at(offered, 6900))
    np.testing.assert_array_equal(closed, np.float32([*plan.trajectory[29], 0.0, 0.0]))
    assert receiver.hold_time == 0.5
    receiver.act(at(offered, 7400))
    assert receiver.hold_time == 0.13
    last = receiver.act(at(offered, 12_000))
    assert receiver.hold_time == float("inf")
    assert last[7:].tolist() == [0.0, 0.0]


def test_the_plan_leads_from_the_start_to_the_chosen_goal(offered: Observation) -> None:
    receiver = omg()
    receiver.act(at(offered, 3000))
    plan = receiver.plan
    assert plan is not None
    assert plan.trajectory.shape == (30, 7)
    np.testing.assert_allclose(plan.trajectory[-5:], plan.goals.tails[plan.chosen], atol=0.02)
    steps = np.abs(np.diff(plan.trajectory, axis=0, prepend=plan.start[None]))
    assert steps.max() < 0.5


def test_it_means_to_go_where_the_plan_leads(offered: Observation) -> None:
    receiver = omg()
    assert receiver.intention is None
    receiver.act(at(offered, 3000))
    plan, meant = receiver.plan, receiver.intention
    assert plan is not None
    assert meant is not None
    joints = np.concatenate([plan.trajectory, np.full((30, 2), 0.04)], axis=1)
    frames = motion_frames(DATA.scene(SCENE).assets.panda, joints, receiver.world_from_base)
    np.testing.assert_allclose(meant[:, :3], frames.path(HAND_LINK), atol=1e-6)
    ahead = compose_point(meant[-1], np.array([0.0, 0.0, 0.1]))
    assert np.linalg.norm(ahead - offered["object_poses"][0, :3]) < 0.15
    receiver.act(at(offered, 7400))
    assert receiver.intention is None


def test_the_way_to_the_goal_is_straight(offered: Observation) -> None:
    receiver = omg()
    receiver.act(at(offered, 3000))
    actions = [receiver.act(at(offered, 7400 + 130 * number)) for number in range(40)]
    way = np.array([action[:7] for action in actions], dtype=np.float64)
    points = compose_point(receiver.world_from_base, receiver.arm.chain(way).origins[-1].T)
    # The observation stays as it is, so the line begins where the hand is at 3 s.
    start, goal = offered["gripper_pose"][:3].astype(np.float64), np.array(receiver.context.protocol.goal_center)
    length = float(np.linalg.norm(goal - start))
    along = (points - start) @ (goal - start) / length
    aside = np.linalg.norm(points - start - along[:, None] * (goal - start) / length, axis=1)
    assert aside.max() < 2e-3
    count = int(np.ceil(length / 0.03))
    np.testing.assert_allclose(along[:count], length * np.arange(1, count + 1) / count, atol=2e-3)
    np.testing.assert_allclose(points[count:], np.tile(goal, (40 - count, 1)), atol=2e-3)


def test_the_same_plan_each_time_and_for_any_control_period(offered: Observation) -> None:
    receiver, again = omg(), omg()
    first, second = receiver.act(at(offered, 3000)), again.act(at(offered, 3000))
    np.testing.assert_array_equal(first, second)
    assert receiver.plan is not None
    assert again.plan is not None
    np.testing.assert_array_equal(receiver.plan.trajectory, again.plan.trajectory)
    receiver.reset()
    receiver.act(at(offered, 3000))
    np.testing.assert_array_equal(receiver.plan.trajectory, again.plan.trajectory)


def test_asked_more_often_it_commands_the_same() -> None:
    commands = []
    for period in (None, 1, 2, 5, 10):
        episode, receiver = Episode("fast"), omg()
        episode.reset(DATA.scene(SCENE))
        clock = PolicyClock(receiver)
        clock.reset(None)
        actions = []
        while not episode.status:
            seen, now = episode.observe(), episode.steps
            action = clock.ask(seen, now) if period is None else receiver.act(seen)
            count = min(clock.due, 13_000) - now if period is None else period
            episode.advance(action, count)
            actions += [action] * (episode.steps - now)
        commands.append((int(episode.status), np.array(actions)))
        episode.close()
    for status, actions in commands[1:]:
        assert status == commands[0][0]
        np.testing.assert_array_equal(actions, commands[0][1])


@pytest.mark.parametrize("physics", ["fast", "exact"])
def test_plays_in_both_physics_and_counts_planning(physics: str) -> None:
    report = benchmark("s0", "train", "omg", scenes=[SCENE], dataset="synthetic", physics=physics, progress=False)
    (episode,) = report.episodes
    assert episode.plan_time > 0.01
    assert episode.steps > 3000


def test_any_number_of_workers() -> None:
    scenes = [5, 6, 25]
    one, two = (
        benchmark(
            "s0",
            "train",
            "omg_hand_aware",
            scenes=scenes,
            dataset="synthetic",
            physics="fast",
            progress=False,
            workers=workers,
        )
        for workers in (1, 2)
    )
    assert [(e.status, e.steps) for e in one.episodes] == [(e.status, e.steps) for e in two.episodes]


def test_in_a_parallel_environment() -> None:
    env = parallel_env(setup="s0", split="train", dataset="synthetic", physics="fast", control_period=0.01)
    observations, _ = env.reset(seed=0, options={"scene_id": SCENE})
    receiver = omg()
    while env.agents and observations["receiver"]["time"][0] < 3.5:
        action = receiver.act(observations["receiver"])
        observations, *_ = env.step({"receiver": action, "giver": np.zeros(8, dtype=np.float32)})
    assert receiver.plan is not None
    env.close()


def test_out_of_reach_it_stays_and_says_why(offered: Observation, caplog: pytest.LogCaptureFixture) -> None:
    far = offered["object_poses"].copy()
    far[0, :3] += [0.0, 3.0, 0.0]
    receiver = omg()
    with caplog.at_level(logging.WARNING):
        action = receiver.act({**at(offered, 3000), "object_poses": far})
    np.testing.assert_array_equal(action, np.float32(WAITING_JOINTS))
    assert receiver.hold_time == float("inf")
    name = DATA.info(SCENE).target_name
    assert name in caplog.text
    assert "reached" in caplog.text
    np.testing.assert_array_equal(receiver.act(at(offered, 9000)), np.float32(WAITING_JOINTS))


def test_without_grasps_it_stays_and_says_why(offered: Observation, caplog: pytest.LogCaptureFixture) -> None:
    classes = offered["object_classes"].copy()
    classes[0] = 1
    receiver = omg()
    with caplog.at_level(logging.WARNING):
        action = receiver.act({**at(offered, 3000), "object_classes": classes})
    np.testing.assert_array_equal(action, np.float32(WAITING_JOINTS))
    assert "002_master_chef_can" in caplog.text


def test_without_its_libraries_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("handover_marl.receivers.omg.importlib.util.find_spec", lambda name: None)
    with pytest.raises(OptionError, match=r"handover-marl\[planning\]"):
        receivers.make("omg", DATA)


def test_asked_before_reset(offered: Observation) -> None:
    with pytest.raises(ResetNeededError, match="reset"):
        receivers.make("omg", DATA).act(at(offered, 3000))


def test_picture_of_a_plan(tmp_path: Path) -> None:
    path = render_plan(
        SCENE, tmp_path / "new" / "plan.png", receiver="omg_hand_aware", physics="fast", dataset="synthetic"
    )
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(OptionError, match="png"):
        render_plan(SCENE, tmp_path / "plan.gif")
    with pytest.raises(OptionError, match="plans nothing"):
        render_plan(SCENE, tmp_path / "plan.png", receiver="hold", dataset="synthetic")


@given(st.integers(0, 10_000))
def test_plans_do_not_hang_on_the_last_bit_of_a_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.concatenate([rng.normal(size=(3, 3)), Rotation.random(3, rng).as_quat()], axis=1)
    steady = _steady(poses)
    np.testing.assert_allclose(steady[:, :3], poses[:, :3], atol=1e-5)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", steady[:, 3:], poses[:, 3:])), 1.0, atol=1e-8)
    # In the middle of a step, so that a last bit cannot lead over its edge.
    middle = 1e-5 * np.round(poses / 1e-5)
    np.testing.assert_array_equal(_steady(middle + 1e-9), _steady(middle))
    np.testing.assert_array_equal(_steady(np.concatenate([middle[:, :3], -middle[:, 3:]], axis=1)), _steady(middle))
