import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn

from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork, PolicyHead
from handover_marl.learning.networks.point_encoders import PointNetPlusPlus
from tests.learning.networks.test_point_sampling import DEVICES, farthest_by_loops, neighbours_by_loops

Array = npt.NDArray[np.float64]


def size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def lively(module: nn.Module) -> nn.Module:
    """Return the module in evaluation mode, with random batch statistics and larger weights.

    The larger weights ensure that centimetres change the outputs.
    """
    generator = torch.Generator().manual_seed(1)
    for name, parameter in module.named_parameters():
        if name.endswith("stages.0.mlps.0.0.weight"):
            parameter.data *= 30.0
        elif "mlps" in name and parameter.ndim == 4:
            parameter.data *= 2.0
    for name, buffer in module.named_buffers():
        if name.endswith("running_mean"):
            buffer.copy_(0.1 * torch.randn(buffer.shape, generator=generator))
        elif name.endswith("running_var"):
            buffer.copy_(0.5 + torch.rand(buffer.shape, generator=generator))
    return module.eval()


def patch(seed: int, count: int, batch: int = 1) -> torch.Tensor:
    """Return points of a patch as large as an object, and flags (B, 4, N)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.06, -0.06, 0.15), (0.06, 0.06, 0.25), (batch, count, 3))
    flags = rng.integers(0, 2, (batch, count, 1))
    return torch.tensor(np.concatenate([points, flags], axis=2), dtype=torch.float32).transpose(1, 2)


def test_as_large_as_the_published_ones() -> None:
    assert [size(PointNetPlusPlus(channels)) for channels in (4, 5, 10, 14)] == [
        1_398_336,
        1_398_400,
        1_398_720,
        1_398_976,
    ]
    assert size(PolicyHead()) == 202_259


class ByLoops:
    """Reference implementation of the encoder in NumPy, with loops over points."""

    def __init__(self, encoder: nn.Module) -> None:
        self._weights = {name: value.numpy().astype(np.float64) for name, value in encoder.state_dict().items()}

    def __call__(self, cloud: Array) -> Array:
        places, features = cloud[:3].T, cloud.T
        for stage, (count, radius, neighbours) in enumerate(((32, 0.02, 64), (32, 0.04, 128))):
            rounded = places.astype(np.float32)
            chosen = farthest_by_loops(rounded, count)
            rows = []
            for center in chosen:
                near = neighbours_by_loops(rounded, rounded[center], radius, neighbours)
                group = np.concatenate([places[near] - places[center], features[near]], axis=1)
                rows.append(self._shared(f"stages.{stage}.mlps.0.", group).max(axis=0))
            places, features = places[chosen], np.array(rows)
        vector = self._shared("stages.2.mlps.0.", np.concatenate([places, features], axis=1)).max(axis=0)
        for layer in (0, 3):
            weight, bias = (self._weights[f"dense.{layer}.{part}"] for part in ("weight", "bias"))
            vector = np.maximum(self._normalised(f"dense.{layer + 1}.", weight @ vector + bias), 0.0)
        return vector

    def _shared(self, prefix: str, values: Array) -> Array:
        for layer in (0, 3, 6):
            weight = self._weights[f"{prefix}{layer}.weight"][..., 0, 0]
            values = np.maximum(self._normalised(f"{prefix}{layer + 1}.", values @ weight.T), 0.0)
        return values

    def _normalised(self, prefix: str, values: Array) -> Array:
        mean, variance, scale, shift = (
            self._weights[prefix + part] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return (values - mean) / np.sqrt(variance + 1e-5) * scale + shift


@pytest.mark.parametrize("count", [40, 700])
def test_the_encoder_is_what_its_table_says(count: int) -> None:
    torch.manual_seed(0)
    encoder, cloud = lively(PointNetPlusPlus(4)), patch(count, count)
    with torch.no_grad():
        found = encoder(cloud)[0].numpy()
    expected = ByLoops(encoder)(cloud[0].numpy().astype(np.float64))
    other = ByLoops(encoder)(patch(count + 1, count)[0].numpy().astype(np.float64))
    assert np.abs(other - expected).max() > 0.05
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_a_cloud_alone_gives_what_it_gives_among_others(device: str) -> None:
    torch.manual_seed(0)
    encoder, many = lively(PointNetPlusPlus(4)).to(device), patch(3, 300, batch=3)
    with torch.no_grad():
        together = encoder(many.to(device)).cpu()
        alone = torch.cat([encoder(one[None].to(device)) for one in many]).cpu()
        at_home = encoder.cpu()(many)
    np.testing.assert_allclose(together, alone, atol=1e-4)
    np.testing.assert_allclose(together, at_home, atol=1e-3)


def test_the_head_is_given_the_time_and_keeps_bounds() -> None:
    torch.manual_seed(0)
    head, features = PolicyHead(), torch.randn(5, 512)
    now, later = (head(features, torch.full((5,), left)) for left in (20.0, 1.0))
    assert (now.action != later.action).any()
    for vast in (head(1000.0 * features, torch.zeros(5)), now):
        assert (vast.action.abs() <= torch.tensor([0.06] * 3 + [np.pi / 6] * 3)).all()
        np.testing.assert_allclose(vast.goal[:, :4].detach().norm(dim=1), 1.0, atol=1e-5)
    assert now.goal.shape == (5, 7)


def test_the_gripper_is_left_out() -> None:
    torch.manual_seed(0)
    network = lively(GaddpgNetwork())
    cloud = patch(0, 1024)[0].numpy().astype(np.float64)
    led = np.concatenate([np.random.default_rng(0).normal(size=(4, 6)), cloud], axis=1)
    first = network.predict_step(led, 7)
    np.testing.assert_array_equal(first, network.train().predict_step(cloud, 7))
    assert first.dtype == np.float32
    assert (first != network.predict_step(cloud, 8)).any()
