import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.learning.networks.grasp_losses import (
    GraspTargets,
    compute_grasp_distances,
    compute_grasp_losses,
    find_enclosed_centers,
    grasp_targets_from_poses,
)
from handover_marl.learning.networks.grasp_network import (
    GraspNetwork,
    GraspNetworkConfig,
    GraspOutputs,
    PointCloudBatch,
)

SMALL = GraspNetworkConfig(point_width=16, group_width=16, cloud_width=16, head_width=16)


def some_views(count: int = 3, seed: int = 0) -> PointCloudBatch:
    draw = torch.Generator().manual_seed(seed)
    return PointCloudBatch(
        0.05 * torch.randn(count, 64, 3, generator=draw) + torch.tensor([0.0, 0.0, 0.4]),
        0.05 * torch.randn(count, 16, 3, generator=draw) + torch.tensor([0.0, 0.1, 0.4]),
        torch.arange(16) < torch.tensor([[16], [5], [0]])[:count],
        torch.stack([torch.randperm(64, generator=draw)[:10] for _ in range(count)]),
        torch.zeros(count, 3),
    )


def network(config: GraspNetworkConfig = SMALL) -> GraspNetwork:
    torch.manual_seed(0)
    return GraspNetwork(config).eval()


def predict(net: GraspNetwork, views: PointCloudBatch) -> GraspOutputs:
    with torch.inference_mode():
        return net(views)


def random_poses(count: int, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    poses = np.concatenate([rng.normal(0.0, 0.1, (count, 3)), Rotation.random(count, rng).as_quat()], axis=1)
    return torch.from_numpy(poses.astype(np.float32))


def test_order_of_points_does_not_matter() -> None:
    views, net = some_views(), network()
    order, hands = torch.randperm(64), torch.arange(15, -1, -1)
    moved = PointCloudBatch(
        views.object_points[:, order],
        views.hand_points[:, hands],
        views.hand_mask[:, hands],
        torch.argsort(order)[views.center_indices],
        views.object_velocity,
    )
    for one, other in zip(predict(net, views), predict(net, moved), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_points_of_the_hand_that_do_not_count_do_not_matter() -> None:
    views, net = some_views(), network()
    hands = torch.where(views.hand_mask[..., None], views.hand_points, torch.tensor(7.0))
    for one, other in zip(predict(net, views), predict(net, views._replace(hand_points=hands)), strict=True):
        torch.testing.assert_close(one, other)
    shown = predict(net, views._replace(hand_points=views.hand_points + 0.1))
    assert not torch.allclose(shown.quality[0], predict(net, views).quality[0])


def grasps_at(good: GraspTargets) -> GraspOutputs:
    nothing = torch.zeros(1, 3)
    return GraspOutputs(torch.zeros(good.quality.shape), good.positions, good.rotations, nothing, nothing)


def test_half_a_turn_is_no_distance_and_a_quarter_is() -> None:
    poses = random_poses(5)
    good = grasp_targets_from_poses(poses[None], torch.ones(1, 5))
    for angle, away in ((np.pi, 0.0), (np.pi / 2, 2.0 * 0.04 * 2.0**0.5 / 3.0)):
        turn = torch.from_numpy(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().astype(np.float32))
        turned = grasps_at(GraspTargets(good.positions, good.rotations @ turn, good.quality))
        found = torch.diagonal(compute_grasp_distances(turned, good)[0])
        torch.testing.assert_close(found, torch.full((5,), away), atol=1e-5, rtol=1e-4)


def test_points_between_the_pads_belong_to_a_grasp() -> None:
    good = grasp_targets_from_poses(torch.tensor([[[0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0]]]), torch.ones(1, 1))
    centers = torch.tensor([[[0.0, 0.0, 0.4], [0.0, 0.03, 0.4], [0.0, 0.06, 0.4], [0.03, 0.0, 0.4], [0.0, 0.0, 0.3]]])
    assert find_enclosed_centers(centers, good)[0, :, 0].tolist() == [True, True, False, False, False]
    nothing = GraspTargets(good.positions, good.rotations, torch.zeros(1, 1))
    assert not find_enclosed_centers(centers, nothing).any()


def test_losses_are_least_for_what_is_good() -> None:
    good = grasp_targets_from_poses(random_poses(4)[None], torch.tensor([[1.0, 0.8, 0.6, 0.0]]))
    sure = torch.logit(good.quality.clamp(1e-4, 1.0 - 1e-4))
    right = grasps_at(good)._replace(quality=sure)
    wrong = right._replace(positions=right.positions + 0.02, quality=-sure)
    nothing = torch.zeros(1, 3)
    best, worse = (compute_grasp_losses(found, good.positions, good, nothing, nothing) for found in (right, wrong))
    assert best.grasp == pytest.approx(0.0, abs=1e-6)
    assert worse.grasp == pytest.approx(0.02 * 3.0**0.5, rel=1e-3)
    assert best.quality < worse.quality
    assert best.object_center == best.object_motion == 0.0


def test_settings_in_files_of_earlier_versions_are_read() -> None:
    old = {"points": 16, "group": 8, "whole": 24, "grasp": 32, "hand": True, "groups": [4]}
    expected = GraspNetworkConfig(16, 8, 24, 32, group_sizes=(4,))
    assert GraspNetwork.from_settings(old).config == expected
    assert GraspNetwork.from_settings(network(expected).get_settings()).config == expected
