"""Tests of vector environments in MuJoCo Warp, on Warp's CPU device, against those in MuJoCo."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra `warp`")

import torch

import handover_marl
from handover_marl.geometry.arrays import to_numpy
from tests.helpers.fake_device import DEVICE, DeviceTensor

# As many environments as there are worlds in the tests of MuJoCo Warp, so that they share kernels.
COUNT = 3
OPTIONS: dict[str, Any] = {
    "dataset": "synthetic",
    "control_period": 0.01,
    "max_cycles": 3,
    "autoreset": "same_step",
    "rewards": "shaped",
}


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.usefixtures("emulated_gpu")
@pytest.mark.parametrize(
    ("agent", "partner", "encoding"),
    [
        ("receiver", "cooperative", {"features": "close_stack", "schemes": "cartesian_delta"}),
        ("receiver", "noisy", {}),
        ("giver", "yang2021", {"features": "giver", "schemes": "deviation"}),
    ],
)
def test_nothing_leaves_the_device_by_chance(agent: str, partner: str, encoding: dict[str, Any]) -> None:
    envs = handover_marl.vector_env(COUNT, agent, partner, backend="warp", device="cuda", **OPTIONS, **encoding)
    envs.reset(seed=0)
    for _ in range(4):
        actions = torch.zeros(envs.action_space.shape, device=DEVICE)
        observations, rewards, *_, infos = envs.step(actions)
    values = observations if isinstance(observations, dict) else {"features": observations}
    for tensor in (*values.values(), rewards, infos["steps"]):
        assert isinstance(tensor, DeviceTensor)
    assert to_numpy(infos["steps"]).tolist() == [10] * COUNT
    envs.close()
