"""Tests of environments whose receiver observes point clouds or images, and of the randomization of cameras."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import handover_marl
from handover_marl import CameraRandomization
from handover_marl.config import make_camera
from handover_marl.errors import OptionError, ResetNeededError
from tests.helpers.equality import assert_equal

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
OPTIONS: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "control_period": 0.15, "scenes": (5, 6)}
TEST: dict[str, Any] = {"split": "test", "scenes": (209,)}
POINTCLOUD = {"wrist_object_points", "wrist_hand_points", "wrist_point_counts"}
RGBD = {"wrist_depth", "wrist_rgb"}
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


@pytest.mark.slow
def test_episodes_draw_noise_of_their_own() -> None:
    env = make(obs_mode="state+rgbd+segmentation", camera_noise="realsense", scenes=[5])
    first = env.reset(seed=0)[0]["receiver"]["wrist_depth"]
    second = env.reset()[0]["receiver"]["wrist_depth"]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, env.reset(seed=0)[0]["receiver"]["wrist_depth"])
    env.close()


@pytest.mark.slow
def test_a_look_is_the_view_of_the_moment() -> None:
    env = make(obs_mode="state+rgbd+segmentation", **TEST)
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


Observation = dict[str, npt.NDArray[Any]]

SMALL = (make_camera("wrist", width=64, height=48), make_camera("front", width=64, height=48))
EVERY = CameraRandomization(0.3, 0.3, 0.01, 0.05, 0.05, 2.0, 0.003, 0.05)
CAMERA_KEYS = [f"{name}_{key}" for name in ("wrist", "front") for key in ("rgb", "depth", "object_points")]


def observe(count: int, randomization: CameraRandomization | None, seed: int = 5, **options: Any) -> Observation:
    """Return the camera data of `count` environments after a reset and a step."""
    own = {"cameras": SMALL, "obs_mode": "rgbd+segmentation+pointcloud", "dataset": "synthetic", **options}
    envs = handover_marl.vector_env(count, "receiver", camera_randomization=randomization, **own)
    envs.reset(seed=seed)
    observations = envs.step(envs.action_space.low)[0]
    envs.close()
    return {key: observations[key] for key in CAMERA_KEYS}


@pytest.mark.slow
@pytest.mark.parametrize("renderer", ["rays", "bullet"])
def test_draws_depend_on_the_seed_of_the_environment_only(renderer: str) -> None:
    pair = observe(2, EVERY, renderer=renderer)
    assert_equal(observe(2, EVERY, renderer=renderer), pair)
    assert_equal(observe(1, EVERY, seed=6, renderer=renderer), {key: value[1:] for key, value in pair.items()})
    plain = observe(2, None, renderer=renderer)
    for key in ("wrist_rgb", "wrist_depth", "front_rgb", "front_depth"):
        assert (pair[key] != plain[key]).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "changed"),
    [
        ("color", 0.5, {"rgb"}),
        ("brightness", 0.5, {"rgb"}),
        ("position", 0.02, {"rgb", "depth", "object_points"}),
        ("rotation", 0.05, {"rgb", "depth", "object_points"}),
        ("focal", 0.1, {"rgb", "depth", "object_points"}),
        ("principal", 5.0, {"rgb", "depth", "object_points"}),
        ("depth_noise_std", 0.01, {"depth", "object_points"}),
    ],
)
def test_each_value_changes_its_data(name: str, value: float, changed: set[str]) -> None:
    plain, other = observe(2, None), observe(2, CameraRandomization(**{name: value}))
    found = {key.split("_", 1)[1] for key in CAMERA_KEYS if not np.array_equal(plain[key], other[key])}
    assert found == changed


@pytest.mark.slow
def test_names_of_noise_may_include_wrong_calibration() -> None:
    wrong_pose = CameraRandomization(position=0.01, rotation=np.deg2rad(2.0))
    assert_equal(observe(2, None, camera_noise="hand_eye"), observe(2, wrong_pose))
    both = replace(wrong_pose, color=0.5)
    assert_equal(observe(2, CameraRandomization(color=0.5), camera_noise="hand_eye"), observe(2, both))
    delayed, plain = observe(2, None, camera_noise="latency"), observe(2, None)
    assert_equal(
        observe(2, None, camera_noise="intrinsics"), observe(2, CameraRandomization(focal=0.01, principal=2.24))
    )
    assert not np.array_equal(delayed["wrist_depth"], plain["wrist_depth"])


@pytest.mark.slow
def test_late_images_show_an_earlier_step() -> None:
    """Images after 0.1 s are those of an earlier step if the random latency is up to 1 s."""
    options: dict[str, Any] = {"dataset": "synthetic", "physics": "mujoco", "obs_mode": "depth", "cameras": SMALL[:1]}
    late, every = (
        handover_marl.parallel_env(camera_randomization=own, control_period=period, **options)
        for own, period in ((CameraRandomization(latency=1.0), 0.1), (None, 0.001))
    )
    actions = {"giver": np.zeros(8, np.float32), "receiver": late.action_space("receiver").high}
    late.reset(seed=4)
    seen = [every.reset(seed=4)[0]["receiver"]["wrist_depth"]]
    seen += [every.step(actions)[0]["receiver"]["wrist_depth"] for _ in range(300)]
    shown = [late.step(actions)[0]["receiver"]["wrist_depth"] for _ in range(3)][-1]
    assert [np.array_equal(shown, one) for one in seen].count(True) >= 1
    assert not np.array_equal(shown, seen[-1])


@pytest.mark.parametrize("value", [{"color": 2.0}, {"latency": -1.0}, {"focal": "a"}])
def test_values_out_of_range_are_refused(value: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(value))):
        CameraRandomization(**value)
    with pytest.raises(OptionError, match="camera_randomization must be a CameraRandomization"):
        handover_marl.parallel_env(dataset="synthetic", camera_randomization=value)
