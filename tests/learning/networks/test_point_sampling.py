import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.learning.networks.point_encoders import (
    gather_columns,
    max_pool_groups,
    query_ball,
    sample_farthest_points,
)

RADIUS = 0.02
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]


def clouds(seed: int, batch: int = 2, count: int = 200) -> torch.Tensor:
    """Return points (B, N, 3) of patches in front of the hand."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.05, -0.05, 0.1), (0.05, 0.05, 0.14), (batch, count, 3))
    return torch.tensor(points, dtype=torch.float32)


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


def neighbours_by_loops(points: np.ndarray, center: np.ndarray, radius: float, count: int) -> list[int]:
    found = [
        number
        for number, point in enumerate(points)
        if np.sum((center - point) ** 2, dtype=np.float32) < np.float32(radius) ** 2
    ][:count]
    return found + [found[0] if found else 0] * (count - len(found))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("seed", range(3))
def test_points_are_chosen_as_the_kernels_choose(seed: int, device: str) -> None:
    points = clouds(seed)
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
        assert indices.tolist() == [neighbours_by_loops(cloud, center, RADIUS, 6) for center in around]


def test_points_near_the_origin_are_padding() -> None:
    points = clouds(0, batch=1)
    points[0, 5] = torch.tensor([-0.03, 0.0, 0.0])
    assert 5 not in sample_farthest_points(points, 32)[0]
    points[0, 5, 0] = -0.032
    assert 5 in sample_farthest_points(points, 32)[0]
    assert sample_farthest_points(0.1 * points, 3).tolist() == [[0, 0, 0]]


def test_the_ball_is_open() -> None:
    points = torch.tensor([[[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.25, 0.0, 1.0]]])
    assert query_ball(points, points[:, :1], 0.5, 3).tolist() == [[[0, 2, 0]]]
    assert query_ball(points, points[:, :1], 0.51, 5).tolist() == [[[0, 1, 2, 0, 0]]]
    assert query_ball(points, points[:, :1] + 9.0, 0.5, 2).tolist() == [[[0, 0]]]


@given(seed=st.integers(0, 2**16), members=st.integers(1, 5))
@settings(max_examples=20)
def test_greatest_of_groups_and_its_gradient(seed: int, members: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    features = torch.randn(3, 7, 4, generator=draw, requires_grad=True)
    groups = torch.randint(7, (3, 6, members), generator=draw)
    wanted = gather_columns(features.transpose(1, 2), groups).amax(dim=-1).transpose(1, 2)
    weights = torch.randn(3, 6, 4, generator=draw)
    # If a group has a point twice, `amax` splits the gradient between both entries; the sum for the point is the same.
    (gradient,) = torch.autograd.grad((wanted * weights).sum(), features)
    found = max_pool_groups(features, groups)
    assert found.equal(wanted)
    assert torch.autograd.grad((found * weights).sum(), features)[0].allclose(gradient, atol=1e-6)
