"""Tests of vector environments in MuJoCo Warp and their cameras, on Warp's CPU device, against those in MuJoCo."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra `warp`")
pytest.importorskip("embreex", reason="needs the extra `vision`")

import torch

import handover_marl
from handover_marl.envs.custom_rewards import combine_rewards
from handover_marl.episode import warp_sensors
from handover_marl.errors import OptionError
from handover_marl.geometry.arrays import to_numpy
from handover_marl.learning.encodings.custom import declare_size
from tests.helpers.fake_device import DEVICE, DeviceTensor

pytestmark = pytest.mark.slow

# As many environments as there are worlds in the tests of MuJoCo Warp, so that they share kernels.
COUNT = 3
OPTIONS: dict[str, Any] = {
    "dataset": "synthetic",
    "control_period": 0.01,
    "max_cycles": 3,
    "autoreset": "same_step",
    "rewards": "shaped",
}


def test_receivers_of_both_backends_agree() -> None:
    arrays = handover_marl.vector_env(COUNT, "receiver", "noisy", **OPTIONS)
    tensors = handover_marl.vector_env(COUNT, "receiver", "noisy", backend="warp", **OPTIONS)
    expected, found = arrays.reset(seed=3), tensors.reset(seed=3)
    targets = expected[0]["robot_joint_position"]
    for step in range(4):
        compare(found[0], expected[0])
        targets = targets + np.float32(0.01)
        expected, found = arrays.step(targets), tensors.step(torch.as_tensor(targets))
        for values in found[1:4]:
            assert isinstance(values, torch.Tensor)
        np.testing.assert_allclose(found[1], expected[1], atol=1e-4)
        np.testing.assert_array_equal(found[3], expected[3])
        np.testing.assert_array_equal(found[4]["scene_id"], expected[4]["scene_id"])
        if step == 2:
            assert found[3].all()
            compare(found[4]["final_obs"][0], expected[4]["final_obs"][0])
            np.testing.assert_array_equal(found[4]["final_info"]["steps"], 30)
    arrays.close()
    tensors.close()


def compare(found: dict[str, Any], expected: dict[str, Any]) -> None:
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        assert isinstance(found[key], torch.Tensor)
        tolerance = 1e-2 if key == "robot_joint_velocity" else 1e-4
        np.testing.assert_allclose(found[key], values, atol=tolerance, err_msg=key)


def test_environments_can_be_stepped_in_the_inference_mode_of_a_collector() -> None:
    envs = handover_marl.vector_env(COUNT, "receiver", "replay", backend="warp", **OPTIONS)
    with torch.inference_mode():
        observations, _ = envs.reset(seed=0)
        for _ in range(4):
            observations, *_ = envs.step(observations["robot_joint_position"])
    # Outside this mode, tensors that were made in it cannot be changed.
    observations, _ = envs.reset(seed=1)
    assert not observations["robot_joint_position"].is_inference()
    envs.close()
    envs.close()


@pytest.mark.usefixtures("emulated_gpu")
@pytest.mark.parametrize(
    ("agent", "partner", "options"),
    [
        ("receiver", "cooperative", {"features": "close_stack", "action_scheme": "cartesian_delta"}),
        ("receiver", "noisy", {}),
        ("receiver", "replay", {"obs_mode": "state+scene_pointcloud"}),
        ("giver", "yang2021", {"features": "giver", "action_scheme": "deviation"}),
    ],
)
def test_nothing_leaves_the_device_by_chance(agent: str, partner: str, options: dict[str, Any]) -> None:
    envs = handover_marl.vector_env(COUNT, agent, partner, backend="warp", device="cuda", **OPTIONS, **options)
    envs.reset(seed=0)
    for _ in range(4):
        actions = torch.zeros(envs.action_space.shape, device=DEVICE)
        observations, rewards, *_, infos = envs.step(actions)
    values = observations if isinstance(observations, dict) else {"features": observations}
    for tensor in (*values.values(), rewards, infos["steps"]):
        assert isinstance(tensor, DeviceTensor)
    assert to_numpy(infos["steps"]).tolist() == [10] * COUNT
    envs.close()


#: Vector environments whose receivers are controlled from outside.
RECEIVERS: dict[str, Any] = {**OPTIONS, "agent": "receiver", "partner": "replay"}
WARP: dict[str, Any] = {"backend": "warp"}
SEED = 5


def read_rows(observations: Any) -> list[dict[str, np.ndarray]]:
    """Return the observations of all environments as NumPy arrays."""
    return [{key: to_numpy(values[row]) for key, values in observations.items()} for row in range(COUNT)]


def assert_same_points(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Assert that clouds that are not subsampled have the same points, but for few at edges."""
    counts, others = found["wrist_point_counts"], expected["wrist_point_counts"]
    assert np.abs(counts - others).max() <= 2
    for number, key in enumerate(("wrist_object_points", "wrist_hand_points", "wrist_other_points")[: len(counts)]):
        own, other = (
            cloud[: int(count)] for cloud, count in ((found[key], counts[number]), (expected[key], others[number]))
        )
        if 0 < counts[number] <= 1024:
            distances = np.linalg.norm(own[:, None] - other, axis=-1).min(axis=1)
            assert (distances < 1e-4).mean() > 0.98
        assert not found[key][len(own) :].any()


def test_clouds_equal_those_of_single_environments() -> None:
    options: dict[str, Any] = {"obs_mode": "state+scene_pointcloud+point_map", "camera_model": "pinhole"}
    envs = handover_marl.vector_env(COUNT, **WARP, **RECEIVERS, **options)
    observations, _ = envs.reset(seed=SEED)
    found = read_rows(observations)
    assert any(0 < one["wrist_point_counts"][1] <= 1024 for one in found)
    for row, own in enumerate(found):
        assert envs.single_observation_space.contains(own)
        single = handover_marl.parallel_env(
            dataset=OPTIONS["dataset"], physics="mujoco", **options, rewards=OPTIONS["rewards"]
        )
        expected, _ = single.reset(seed=SEED + row)
        assert_same_points(own, expected["receiver"])
        errors = np.linalg.norm(own["wrist_point_map"] - expected["receiver"]["wrist_point_map"], axis=-1)
        assert (errors < 1e-4).mean() > 0.98
        single.close()
    envs.close()


def test_episodes_and_their_clouds_repeat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clouds depend on the seed of an environment, neither on the others nor on the size of chunks."""
    monkeypatch.setattr(warp_sensors, "N_POINTS", 32)
    monkeypatch.setitem(warp_sensors.camera_observation_space.__globals__, "N_POINTS", 32)
    found = []
    for chunk in (64, 2):
        monkeypatch.setattr(warp_sensors, "_CHUNK", chunk)
        envs = handover_marl.vector_env(COUNT, obs_mode="pointcloud", **WARP, **RECEIVERS)
        observations, _ = envs.reset(seed=[SEED, SEED, SEED + 1])
        found.append(read_rows(observations))
        envs.close()
    for first, second in zip(*found, strict=True):
        np.testing.assert_equal(first, second)
    np.testing.assert_equal(found[0][0], found[0][1])
    assert (found[0][0]["wrist_point_counts"][0]) > 32


@declare_size(2)
def count_points(observation: dict[str, Any]) -> np.ndarray:
    assert "object_poses" not in observation
    return np.array(observation["wrist_point_counts"][:2], dtype=np.float32)


@declare_size(1)
def move(outputs: np.ndarray, observation: dict[str, Any]) -> np.ndarray:
    return np.asarray(observation["robot_joint_position"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obs_mode": "full_pointcloud"}, "an obs_mode without full_pointcloud, got"),
        ({"camera_noise": "realsense"}, "camera_noise=None, got 'realsense'"),
        ({"renderer": "bullet"}, "the renderer 'rays', got 'bullet'"),
        ({"rewards": combine_rewards("sparse")}, "weights of the library's terms"),
        ({"action_scheme": move, "features": count_points}, "a built-in action scheme"),
        ({"agent": "giver", "partner": "vision", "obs_mode": "state"}, "a partner without a camera, got 'vision'"),
    ],
    ids=["full", "noise", "renderer", "rewards", "scheme", "partner"],
)
def test_what_the_device_cannot_observe_is_refused(options: dict[str, Any], message: str) -> None:
    chosen = {**RECEIVERS, "obs_mode": "pointcloud", **options}
    with pytest.raises(OptionError, match=f"{message}.*"):
        handover_marl.vector_env(2, **WARP, **chosen)
