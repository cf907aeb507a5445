"""Tests of environments whose receiver observes point clouds or images of the wrist camera."""

from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.errors import ResetNeededError
from handover_marl.receivers import Receiver
from tests.helpers.equality import assert_equal

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
OPTIONS: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "control_period": 0.15, "scenes": (5, 6)}
TEST: dict[str, Any] = {"split": "test", "scenes": (209,)}
POINTCLOUD = {"wrist_object_points", "wrist_hand_points", "wrist_point_counts"}
RGBD = {"wrist_depth", "wrist_segmentation", "wrist_rgb"}
FULL_POINTCLOUD = {"wrist_object_cloud", "wrist_hand_cloud", "wrist_point_counts", "robot_joint_position_exact"}
KEYS = {"pointcloud": POINTCLOUD, "rgbd": RGBD, "full_pointcloud": FULL_POINTCLOUD}
OWN = {"robot_joint_position", "robot_joint_velocity", "gripper_pose", "time"}
START = np.array([0.0, -1.285, 0.0, -2.356, 0.0, 1.571, 0.785, 0.04, 0.04], dtype=np.float32)


def make(**options: Any) -> handover_marl.HandoverEnv:
    return handover_marl.parallel_env(**OPTIONS | options)


def rollout(steps: int = 8, seed: int = 3, looks: bool = False, **options: Any) -> list[dict[str, np.ndarray]]:
    """Simulate small random motions of the arm and return the receiver's observations.

    If `looks` is true, `capture_wrist_camera` is called before every step.
    """
    env = make(**{"obs_mode": "state+pointcloud", **options})
    seen = [env.reset(seed=seed)[0]["receiver"]]
    rng = np.random.default_rng(0)
    while env.agents and len(seen) <= steps:
        if looks:
            env.capture_wrist_camera()
        action = START + rng.uniform(-0.1, 0.1, 9).astype(np.float32)
        seen.append(env.step({"giver": np.zeros(8, dtype=np.float32), "receiver": action})[0]["receiver"])
    env.close()
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("data", KEYS)
def test_what_is_seen_is_in_the_space(data: str) -> None:
    blind, both, env = make(), make(obs_mode=f"state+{data}"), make(obs_mode=data)
    plain, seeing = (one.observation_space("receiver") for one in (blind, both))
    assert set(seeing.spaces) - set(plain.spaces) == KEYS[data]
    assert both.observation_space("giver") == blind.observation_space("giver")
    assert both.state_space == blind.state_space
    observations, _ = env.reset(seed=0)
    assert set(observations["receiver"]) == set(env.observation_space("receiver").spaces) == OWN | KEYS[data]
    assert "object_poses" in observations["giver"]
    assert env.observation_space("receiver").contains(observations["receiver"])
    assert env.step({"giver": np.zeros(8, dtype=np.float32), "receiver": START})[1]["receiver"] == 0.0
    env.close()


@pytest.mark.slow
def test_whole_rollouts_repeat_whoever_looks() -> None:
    first, noisy = rollout(), rollout(camera_noise="realsense")
    assert max(float(seen["wrist_point_counts"][0]) for seen in first) > 50
    assert_equal(first, rollout(looks=True))
    assert_equal(noisy, rollout(camera_noise="realsense", looks=True))
    assert any(
        not np.array_equal(one["wrist_object_points"], two["wrist_object_points"])
        for one, two in zip(first, noisy, strict=True)
    )


@pytest.mark.slow
def test_looking_changes_nothing_else() -> None:
    blind = rollout(3, obs_mode="state", physics="exact")
    seeing = rollout(3, physics="exact", renderer="bullet", looks=True)
    assert_equal(blind, [{key: value for key, value in seen.items() if key not in POINTCLOUD} for seen in seeing])


def test_episodes_draw_noise_of_their_own() -> None:
    env = make(obs_mode="state+rgbd", camera_noise="realsense", scenes=[5])
    first = env.reset(seed=0)[0]["receiver"]["wrist_depth"]
    second = env.reset()[0]["receiver"]["wrist_depth"]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, env.reset(seed=0)[0]["receiver"]["wrist_depth"])
    env.close()


def test_a_look_is_the_view_of_the_moment() -> None:
    env = make(obs_mode="state+rgbd", **TEST)
    with pytest.raises(ResetNeededError):
        env.capture_wrist_camera()
    observation = env.reset(seed=0, options={"scene_id": 209})[0]["receiver"]
    for _ in range(12):
        observation = env.step({"giver": np.zeros(8, dtype=np.float32), "receiver": START})[0]["receiver"]
    view = env.unwrapped.capture_wrist_camera()
    np.testing.assert_array_equal(view.depth, observation["wrist_depth"][..., 0])
    np.testing.assert_array_equal(view.segmentation, observation["wrist_segmentation"][..., 0])
    np.testing.assert_array_equal(view.rgb, observation["wrist_rgb"])
    env.close()


class Looker(Receiver):
    """Receiver that observes point clouds only; the number of points shifts the target of its first joint."""

    name = "looker"
    obs_mode = "pointcloud"

    def reset(self, seed: int | None = None) -> None:
        self.asked = 0

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        assert set(observation) == OWN | POINTCLOUD
        self.asked += 1
        shift = np.float32(1e-4) * observation["wrist_point_counts"].sum()
        return START + np.array([shift, *[0.0] * 8], dtype=np.float32)


def test_frozen_receivers_see_what_they_ask_for() -> None:
    env = handover_marl.freeze(make(), "giver", Looker, api="gymnasium")
    env.reset(seed=0)
    for _ in range(3):
        observation = env.step(np.zeros(8, dtype=np.float32))[0]
    assert "wrist_object_points" not in observation
    env.close()
