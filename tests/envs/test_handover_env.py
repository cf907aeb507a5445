import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

import handover_marl
from handover_marl.config import CameraConfig, PandaConfig
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.episode.spaces import GIVER_ACTION_SIZE
from handover_marl.errors import (
    ActionError,
    DataNotFoundError,
    OptionError,
    ResetNeededError,
    SceneError,
    SimulationError,
    UnknownNameError,
)
from handover_marl.protocol.status import EpisodeStatus

START = np.array(PandaConfig().start_joints, dtype=np.float32)
REPLAY = np.zeros(GIVER_ACTION_SIZE, dtype=np.float32)

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def make(data: Path, **options: Any) -> HandoverEnv:
    return handover_marl.parallel_env(data_dir=data, **{"split": "val", **options})


def both(receiver: Any, giver: Any = REPLAY) -> dict[str, Any]:
    return {"giver": giver, "receiver": receiver}


def rollout(env: HandoverEnv, n_steps: int, seed: int = 3, scene_id: int = 9) -> list[dict[str, np.ndarray]]:
    observations, _ = env.reset(seed=seed, options={"scene_id": scene_id})
    rng = np.random.default_rng(seed)
    seen = [observations["receiver"]]
    while env.agents and len(seen) <= n_steps:
        action = START + rng.uniform(-0.3, 0.3, 9).astype(np.float32)
        seen.append(env.step(both(action))[0]["receiver"])
    return seen


def assert_same(first: list[dict[str, np.ndarray]], second: list[dict[str, np.ndarray]]) -> None:
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        for key, value in one.items():
            np.testing.assert_array_equal(value, other[key], err_msg=key)


@pytest.fixture
def only_known_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """API tests draw scenes; the small dataset has but a few of each split."""
    splits = {("s0", "train"): (5, 6), ("s0", "val"): (9, 14)}
    monkeypatch.setattr(
        "handover_marl.datasets.official.OfficialDataset.split", lambda self, setup, split: splits[setup, split]
    )


@pytest.mark.usefixtures("only_known_scenes")
class TestPettingZooApi:
    def test_parallel(self, fake_data: Path) -> None:
        parallel_api_test(make(fake_data), num_cycles=40)

    def test_aec(self, fake_data: Path) -> None:
        api_test(handover_marl.env(data_dir=fake_data), num_cycles=40)

    def test_seed(self, fake_data: Path) -> None:
        parallel_seed_test(lambda: make(fake_data))

    @pytest.mark.parametrize("kind", ["parallel", "aec"])
    def test_registry(self, fake_data: Path, kind: str) -> None:
        env = pettingzoo.make(kind, "HandoverMARL/Handover-v0", data_dir=fake_data, split="val")
        env.reset(seed=1)
        assert set(env.possible_agents) == {"giver", "receiver"}
        env.close()

    def test_scenes_are_drawn_by_seed_and_go_on_without(self, fake_data: Path) -> None:
        def draw(env: HandoverEnv, seed: int | None) -> list[int]:
            return [env.reset(seed=seed if n == 0 else None)[1]["giver"]["scene_id"] for n in range(8)]

        env = make(fake_data)
        first = draw(env, 7)
        assert draw(env, 7) == first == draw(make(fake_data), 7)
        assert set(first) == {9, 14}


def test_whole_rollouts_repeat(fake_data: Path) -> None:
    env = make(fake_data)
    first = rollout(env, 25)
    assert_same(first, rollout(env, 25))
    assert_same(first, rollout(make(fake_data), 25))


def test_one_scene_leaves_nothing_behind_for_the_next(fake_data: Path) -> None:
    fresh = rollout(make(fake_data), 10, scene_id=14)
    used = make(fake_data)
    rollout(used, 10, scene_id=9)
    assert_same(fresh, rollout(used, 10, scene_id=14))


def test_control_period_only_groups_steps(fake_data: Path) -> None:
    coarse, fine = make(fake_data), make(fake_data, control_period=0.001)
    for env in (coarse, fine):
        env.reset(options={"scene_id": 9})
    for _ in range(5):
        one = coarse.step(both(START))[0]["receiver"]
        for _ in range(100):
            other = fine.step(both(START))[0]["receiver"]
        assert_same([one], [other])


def test_copies_build_their_own_world(fake_data: Path) -> None:
    env = make(fake_data)
    first = rollout(env, 5)
    copy = pickle.loads(pickle.dumps(env))
    assert_same(first, rollout(copy, 5))
    copy.close()
    del copy
    assert_same(first, rollout(env, 5))


def test_observations_are_in_their_spaces_and_not_shared(fake_data: Path) -> None:
    env = make(fake_data)
    observations, _ = env.reset(options={"scene_id": 14})
    for agent in env.agents:
        assert env.observation_space(agent).contains(observations[agent])
    np.testing.assert_array_equal(observations["giver"]["object_mask"], [1, 1, 1, 0, 0])
    np.testing.assert_array_equal(observations["giver"]["object_classes"], [3, 11, 21, 0, 0])
    np.testing.assert_array_equal(observations["giver"]["robot_joint_position"], START)
    observations["giver"]["robot_joint_position"][:] = 9.0
    np.testing.assert_array_equal(observations["receiver"]["robot_joint_position"], START)
    assert env.state_space.contains(env.state())


def test_the_hand_comes_and_goes(fake_data: Path) -> None:
    env = make(fake_data, control_period=0.01)
    env.reset(options={"scene_id": 9})
    present = []
    for _ in range(40):
        seen = env.step(both(START))[0]["giver"]
        present.append(bool(seen["hand_present"][0]))
        assert present[-1] == seen["hand_keypoints"].any() == seen["hand_dof_position"].any()
    # Frames 50 to 350 have a hand; it goes one frame after its last.
    assert present == [False] * 4 + [True] * 31 + [False] * 5
    assert abs(float(seen["time"][0]) - 0.4) < 1e-6


def test_keypoints_are_wrist_and_joint_origins(fake_data: Path) -> None:
    env = make(fake_data, control_period=0.06)
    env.reset(options={"scene_id": 9})
    seen = env.step(both(START))[0]["giver"]
    np.testing.assert_allclose(seen["hand_keypoints"][0], seen["hand_dof_position"][:3], atol=1e-3)
    knuckles = seen["hand_keypoints"][1::3] - seen["hand_keypoints"][0]
    np.testing.assert_allclose(knuckles[:, 0], -0.06, atol=2e-3)
    np.testing.assert_allclose(np.diff(knuckles[:, 2]), -0.02, atol=2e-3)


def test_infos_and_timeout(fake_data: Path) -> None:
    env = make(fake_data, control_period=1.0)
    _, infos = env.reset(options={"scene_id": 9})
    assert infos["receiver"] == {"scene_id": 9, "status": EpisodeStatus.RUNNING, "steps": 0} | dict.fromkeys(
        ("release_step", "release")
    )
    while env.agents:
        _, rewards, ended, timed_out, infos = env.step(both(START))
    assert infos["giver"]["status"] is EpisodeStatus.TIMEOUT
    assert infos["giver"]["steps"] == 13_000
    assert timed_out == {"giver": True, "receiver": True}
    assert ended == {"giver": False, "receiver": False}
    assert rewards == {"giver": 0.0, "receiver": 0.0}
    with pytest.raises(ResetNeededError):
        env.step(both(START))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (START[:8], r"shape \(8,\).*expected \(9,\)"),
        (np.zeros((1, 9)), r"shape \(1, 9\)"),
        (np.where(np.arange(9) == 4, np.nan, START), "component 4 is nan"),
        (np.full(9, 1e300), "not finite"),
        ("left", "receiver"),
        (None, "receiver"),
        ([[1], [2, 3]], "receiver"),
    ],
)
def test_bad_receiver_actions_leave_the_world_alone(fake_data: Path, action: Any, message: str) -> None:
    env = make(fake_data)
    env.reset(options={"scene_id": 9})
    before = env.state()
    with pytest.raises(ActionError, match=message):
        env.step(both(action))
    np.testing.assert_array_equal(before, env.state())
    assert env.step(both(START))[4]["giver"]["steps"] == 100


@pytest.mark.parametrize("action", [np.zeros(7), np.full(8, np.nan), np.ones((8, 1)), "let go", None])
def test_bad_giver_actions_leave_the_world_alone(fake_data: Path, action: Any) -> None:
    env = make(fake_data)
    env.reset(options={"scene_id": 9})
    before = env.state()
    with pytest.raises(ActionError, match="giver"):
        env.step(both(START, action))
    np.testing.assert_array_equal(before, env.state())


def test_receiver_actions_are_not_clipped(fake_data: Path) -> None:
    env = make(fake_data)
    seen = {}
    for offset in (0.0, 1.0):
        env.reset(options={"scene_id": 9})
        limit = np.array(PandaConfig().upper_limits, dtype=np.float32)
        seen[offset] = env.step(both(limit + np.float32(offset)))[0]["receiver"]["robot_joint_velocity"]
    assert np.abs(seen[0.0] - seen[1.0]).max() > 1e-3


@pytest.mark.parametrize("period", [0, -0.1, 0.0005, 0.0123456, float("nan"), float("inf"), "fast", None])
def test_bad_control_periods(fake_data: Path, period: Any) -> None:
    with pytest.raises(OptionError, match="control_period"):
        make(fake_data, control_period=period)


@pytest.mark.parametrize(
    "options",
    [{"setup": "s7"}, {"split": "dev"}, {"dataset": "coco"}, {"physics": "quick"}, {"render_mode": "ascii"}],
)
def test_unknown_names(fake_data: Path, options: dict[str, str]) -> None:
    with pytest.raises(UnknownNameError, match="valid"):
        make(fake_data, **options)


def test_other_user_errors(fake_data: Path) -> None:
    with pytest.raises(DataNotFoundError, match="synthetic"):
        handover_marl.parallel_env(dataset="dexycb")
    with pytest.raises(OptionError, match="data_dir"):
        handover_marl.parallel_env(dataset="synthetic", data_dir=fake_data)
    env = make(fake_data, render_mode="rgb_array")
    for call in (env.state, env.render):
        with pytest.raises(ResetNeededError):
            call()
    for scene_id in (5, 10_000, "9", 9.5, [9], np.array([9, 14])):
        with pytest.raises(SceneError, match="s0 val"):
            env.reset(options={"scene_id": scene_id})


def test_numpy_scene_numbers(fake_data: Path) -> None:
    env = make(fake_data)
    assert env.reset(options={"scene_id": np.int64(14)})[1]["giver"]["scene_id"] == 14


@pytest.mark.parametrize("actions", [None, START, {"giver": REPLAY, "reciever": START}])
def test_malformed_steps(fake_data: Path, actions: Any) -> None:
    env = make(fake_data)
    env.reset(options={"scene_id": 9})
    with pytest.raises(ActionError):
        env.step(actions)
    with pytest.raises(OptionError, match="options"):
        env.reset(options=[1])  # type: ignore[arg-type]


def test_after_a_failed_reset_there_is_no_episode(own_data: Path) -> None:
    env = make(own_data)
    env.reset(options={"scene_id": 9})
    (own_data / "assets" / "004_sugar_box" / "model_normalized.urdf").write_text("no robot")
    with pytest.raises(SimulationError, match="004_sugar_box"):
        env.reset(options={"scene_id": 14})
    assert env.agents == []
    for call in (lambda: env.step(both(START)), env.state):
        with pytest.raises(ResetNeededError):
            call()
    env.reset(options={"scene_id": 9})
    assert env.step(both(START))[4]["giver"]["steps"] == 100


def test_after_closing(fake_data: Path) -> None:
    env = make(fake_data)
    env.reset(options={"scene_id": 9})
    env.close()
    env.close()
    with pytest.raises(ResetNeededError):
        env.state()
    env.reset(options={"scene_id": 9})
    assert len(env.step(both(START))) == 5


def test_pictures_without_a_screen(fake_data: Path) -> None:
    env = make(fake_data, render_mode="rgb_array", camera=CameraConfig(width=160, height=120))
    env.reset(options={"scene_id": 9})
    first = env.render()
    assert first.shape == (120, 160, 3)
    assert first.dtype == np.uint8
    assert first.std() > 10
    for _ in range(2):
        env.step(both(START + np.float32(0.5)))
    assert (env.render() != first).mean() > 0.005


def test_a_window_needs_a_screen(fake_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    env = make(fake_data, render_mode="human")
    with pytest.raises(SimulationError, match="rgb_array"):
        env.reset(options={"scene_id": 9})
