"""Tests that networks compute the same whatever the program has set in PyTorch."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from handover_marl.assets.shipped import GADDPG_WEIGHTS, find_vision_weights
from handover_marl.geometry.arrays import use_default_torch_settings
from handover_marl.learning.adapters.function_policy import TorchFunction
from handover_marl.learning.adapters.modules import dense_network_from_module
from handover_marl.learning.networks.gaddpg_network import N_POINTS, GaddpgNetwork
from handover_marl.learning.networks.weights import read_network_weights
from handover_marl.receivers.vision.grasp_predictor import load_grasp_predictor

SETTINGS: dict[str, Callable[[], object]] = {
    "bfloat16": lambda: torch.set_default_dtype(torch.bfloat16),
    "float64": lambda: torch.set_default_dtype(torch.float64),
    "autocast": lambda: torch.set_autocast_enabled("cpu", True),
    "device": lambda: torch.set_default_device("meta"),
    "precision": lambda: torch.set_float32_matmul_precision("medium"),
}


def read_settings() -> tuple[object, ...]:
    return (
        torch.get_default_dtype(),
        torch.is_autocast_enabled("cpu"),
        torch.get_default_device(),
        torch.get_float32_matmul_precision(),
        torch.get_rng_state().tolist(),
    )


@pytest.fixture(autouse=True)
def _initial_settings() -> Iterator[None]:
    yield
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)
    torch.set_autocast_enabled("cpu", False)
    torch.set_float32_matmul_precision("highest")


@pytest.fixture(scope="module")
def module() -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(30, 50), torch.nn.Tanh(), torch.nn.Linear(50, 4))


def compute(module: torch.nn.Module) -> list[np.ndarray]:
    """Outputs of the grasp network, of GA-DDPG's network and of a user's module, also as a policy file has it."""
    rng = np.random.default_rng(0)
    points, hand = 0.05 * rng.normal(size=(300, 3)) + [0.0, 0.0, 0.4], 0.05 * rng.normal(size=(50, 3))
    prediction = load_grasp_predictor(find_vision_weights("s0"))[0](points, hand, np.zeros(3), rng)
    network, _ = read_network_weights(GADDPG_WEIGHTS, GaddpgNetwork)
    step = network.predict_step(np.concatenate([points[rng.integers(0, 300, N_POINTS)].T, np.zeros((1, N_POINTS))]), 9)
    inputs = rng.normal(size=30).astype(np.float32)
    outputs, converted = TorchFunction(module)(inputs), dense_network_from_module(module)(inputs)
    return [prediction.grasps, prediction.quality, prediction.center, step, outputs, converted]


@pytest.fixture(scope="module")
def expected(module: torch.nn.Module) -> list[np.ndarray]:
    return compute(module)


@pytest.mark.parametrize("setting", SETTINGS)
def test_outputs_are_equal_to_the_bit(setting: str, module: torch.nn.Module, expected: list[np.ndarray]) -> None:
    SETTINGS[setting]()
    before = read_settings()
    found = compute(module)
    assert read_settings() == before
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_products_have_full_precision() -> None:
    """Few processors and all GPUs compute less precisely; the switches are the same on all."""
    torch.set_float32_matmul_precision("medium")
    with use_default_torch_settings():
        switches: Any = torch.backends
        assert switches.mkldnn.matmul.fp32_precision == switches.cuda.matmul.fp32_precision == "ieee"
    assert torch.get_float32_matmul_precision() == "medium"
    with contextlib.suppress(ZeroDivisionError), use_default_torch_settings():
        _ = 1 / 0
    assert torch.get_float32_matmul_precision() == "medium"
