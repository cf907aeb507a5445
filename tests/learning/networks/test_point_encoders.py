"""Tests of the point cloud encoder: points are chosen as by the original kernels, and layers are those of its table."""

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn

from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork, PolicyHead
from handover_marl.learning.networks.point_encoders import (
    PointNetPlusPlus,
    gather_columns,
    query_ball,
    sample_farthest_points,
)

Array = npt.NDArray[np.float64]
RADIUS = 0.02
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


def farthest_by_loops(points: np.ndarray, count: int) -> list[int]:
    """Return the indices of farthest points as the original kernel does, for one cloud (N, 3) in float32."""
    chosen, distances = [0], np.full(len(points), 1e10, dtype=np.float32)
    while len(chosen) < count:
        best, farthest = 0, np.float32(-1.0)
        for number, point in enumerate(points):
            if np.sum(point * point, dtype=np.float32) <= 1e-3:
                continue
            apart = point - points[chosen[-1]]
            distances[number] = min(distances[number], np.sum(apart * apart, dtype=np.float32))
            if distances[number] > farthest:
                best, farthest = number, distances[number]
        chosen.append(best)
    return chosen


def neighbors_by_loops(points: np.ndarray, center: np.ndarray, radius: float, count: int) -> list[int]:
    squared = np.sum((center - points) ** 2, axis=1, dtype=np.float32)
    found = np.flatnonzero(squared < np.float32(radius) ** 2)[:count].tolist()
    return found + [found[0] if found else 0] * (count - len(found))


def draw_clouds(seed: int, count: int, batch: int = 1) -> torch.Tensor:
    """Return points of patches as large as an object, and flags (B, 4, N)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.06, -0.06, 0.15), (0.06, 0.06, 0.25), (batch, count, 3))
    flags = rng.integers(0, 2, (batch, count, 1))
    return torch.tensor(np.concatenate([points, flags], axis=2), dtype=torch.float32).transpose(1, 2)


@pytest.mark.parametrize("device", DEVICES)
def test_points_are_chosen_as_the_kernels_choose(device: str) -> None:
    points = draw_clouds(0, 300, 2)[:, :3].transpose(1, 2).contiguous()
    points[:, 7] = 0.01
    points[:, 11] = points[:, 3]
    chosen = sample_farthest_points(points.to(device), 32)
    centers = gather_columns(points.to(device).transpose(1, 2), chosen).transpose(1, 2)
    near = query_ball(points.to(device), centers, RADIUS, 6)
    assert (near[..., -1] != near[..., 0]).any(), "as many as are wanted"
    assert (near[..., -1] == near[..., 0]).any(), "fewer"
    for cloud, own, around, indices in zip(
        points.numpy(), chosen.cpu(), centers.cpu().numpy(), near.cpu(), strict=True
    ):
        assert own.tolist() == farthest_by_loops(cloud, 32)
        assert indices.tolist() == [neighbors_by_loops(cloud, center, RADIUS, 6) for center in around]


def test_padding_is_not_sampled_and_balls_are_open() -> None:
    points = draw_clouds(0, 200)[:, :3].transpose(1, 2).contiguous()
    points[0, 5] = torch.tensor([-0.03, 0.0, 0.0])
    assert 5 not in sample_farthest_points(points, 32)[0]
    points[0, 5, 0] = -0.032
    assert 5 in sample_farthest_points(points, 32)[0]
    assert sample_farthest_points(0.1 * points, 3).tolist() == [[0, 0, 0]]
    points = torch.tensor([[[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.25, 0.0, 1.0]]])
    assert query_ball(points, points[:, :1], 0.5, 3).tolist() == [[[0, 2, 0]]]
    assert query_ball(points, points[:, :1], 0.51, 5).tolist() == [[[0, 1, 2, 0, 0]]]
    assert query_ball(points, points[:, :1] + 9.0, 0.5, 2).tolist() == [[[0, 0]]]


def make_lively(module: nn.Module) -> nn.Module:
    """Return the module in evaluation mode, with weights so large that shifts of a centimeter change its outputs."""
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


class EncoderByLoops:
    """Reference implementation of the encoder in NumPy, with loops over points."""

    def __init__(self, encoder: nn.Module) -> None:
        self._weights = {name: value.numpy().astype(np.float64) for name, value in encoder.state_dict().items()}

    def __call__(self, cloud: Array) -> Array:
        places, features = cloud[:3].T, cloud.T
        for stage, (count, radius, neighbors) in enumerate(((32, 0.02, 64), (32, 0.04, 128))):
            rounded = places.astype(np.float32)
            chosen = farthest_by_loops(rounded, count)
            rows = []
            for center in chosen:
                near = neighbors_by_loops(rounded, rounded[center], radius, neighbors)
                group = np.concatenate([places[near] - places[center], features[near]], axis=1)
                rows.append(self._shared(f"stages.{stage}.mlps.0.", group).max(axis=0))
            places, features = places[chosen], np.array(rows)
        vector = self._shared("stages.2.mlps.0.", np.concatenate([places, features], axis=1)).max(axis=0)
        for layer in (0, 3):
            weight, bias = (self._weights[f"dense.{layer}.{part}"] for part in ("weight", "bias"))
            vector = np.maximum(self._normalize(f"dense.{layer + 1}.", weight @ vector + bias), 0.0)
        return vector

    def _shared(self, prefix: str, values: Array) -> Array:
        for layer in (0, 3, 6):
            weight = self._weights[f"{prefix}{layer}.weight"][..., 0, 0]
            values = np.maximum(self._normalize(f"{prefix}{layer + 1}.", values @ weight.T), 0.0)
        return values

    def _normalize(self, prefix: str, values: Array) -> Array:
        mean, variance, scale, shift = (
            self._weights[prefix + part] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return (values - mean) / np.sqrt(variance + 1e-5) * scale + shift


@pytest.mark.parametrize("device", DEVICES)
def test_the_encoder_is_what_its_table_says_for_each_of_several_clouds(device: str) -> None:
    torch.manual_seed(0)
    encoder, clouds = make_lively(PointNetPlusPlus()), draw_clouds(3, 400, batch=2)
    expected = np.stack([EncoderByLoops(encoder)(cloud.numpy().astype(np.float64)) for cloud in clouds])
    assert np.abs(expected[0] - expected[1]).max() > 0.05
    with torch.no_grad():
        found = encoder.to(device)(clouds.to(device)).cpu().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-4 if device == "cpu" else 1e-3)


def test_sizes_are_the_published_ones() -> None:
    def count(module: nn.Module) -> int:
        return sum(parameter.numel() for parameter in module.parameters())

    assert count(PointNetPlusPlus()) == 1_398_336
    assert count(PolicyHead()) == 202_259


def test_the_head_is_given_the_time_and_keeps_bounds() -> None:
    torch.manual_seed(0)
    head, features = PolicyHead(), torch.randn(5, 512)
    now, later = (head(features, torch.full((5,), left)) for left in (20.0, 1.0))
    assert (now.action != later.action).any()
    for vast in (head(1000.0 * features, torch.zeros(5)), now):
        assert (vast.action.abs() <= torch.tensor([0.06] * 3 + [np.pi / 6] * 3)).all()
        np.testing.assert_allclose(vast.goal[:, :4].detach().norm(dim=1), 1.0, atol=1e-5)


def test_the_gripper_is_left_out() -> None:
    torch.manual_seed(0)
    network, cloud = make_lively(GaddpgNetwork()), draw_clouds(0, 1024)[0].numpy().astype(np.float64)
    led = np.concatenate([np.random.default_rng(0).normal(size=(4, 6)), cloud], axis=1)
    first = network.predict_step(led, 7)
    np.testing.assert_array_equal(first, network.train().predict_step(cloud, 7))
    assert first.dtype == np.float32
    assert (first != network.predict_step(cloud, 8)).any()
