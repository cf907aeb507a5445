"""Tests of the grasp network and its losses."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.learning.imitation.vision.training import (
    GraspTargets,
    LabelledClouds,
    compute_grasp_distances,
    compute_grasp_losses,
    find_enclosed_centers,
    grasp_targets_from_poses,
)
from handover_marl.learning.networks.grasp_network import GraspNetwork, GraspOutputs, PointCloudBatch

NOTHING = torch.zeros(1, 3)


def random_targets(quality: list[float]) -> GraspTargets:
    rng = np.random.default_rng(0)
    poses = [rng.normal(0.0, 0.1, (len(quality), 3)), Rotation.random(len(quality), rng).as_quat()]
    return grasp_targets_from_poses(
        torch.from_numpy(np.concatenate(poses, axis=1)).float()[None], torch.tensor([quality])
    )


def grasps_at(good: GraspTargets) -> GraspOutputs:
    return GraspOutputs(torch.zeros(good.quality.shape), good.positions, good.rotations, NOTHING, NOTHING)


def test_order_of_points_and_padding_do_not_matter() -> None:
    draw = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    net = GraspNetwork().eval()
    views = PointCloudBatch(
        0.05 * torch.randn(3, 64, 3, generator=draw) + torch.tensor([0.0, 0.0, 0.4]),
        0.05 * torch.randn(3, 16, 3, generator=draw) + torch.tensor([0.0, 0.1, 0.4]),
        torch.arange(16) < torch.tensor([[16], [5], [0]]),
        torch.stack([torch.randperm(64, generator=draw)[:10] for _ in range(3)]),
        torch.zeros(3, 3),
    )
    order, hands = torch.randperm(64), torch.arange(15, -1, -1)
    moved = PointCloudBatch(
        views.object_points[:, order],
        torch.where(views.hand_mask[..., None], views.hand_points, torch.tensor(7.0))[:, hands],
        views.hand_mask[:, hands],
        torch.argsort(order)[views.center_indices],
        views.object_velocity,
    )
    with torch.inference_mode():
        for one, other in zip(net(views), net(moved), strict=True):
            torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)
        shown = net(views._replace(hand_points=views.hand_points + 0.1))
        assert not torch.allclose(shown.quality[0], net(views).quality[0])


def test_half_a_turn_is_no_distance_and_a_quarter_is() -> None:
    good = random_targets([1.0] * 5)
    for angle, away in ((np.pi, 0.0), (np.pi / 2, 2.0 * 0.04 * 2.0**0.5 / 3.0)):
        turn = torch.from_numpy(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().astype(np.float32))
        turned = grasps_at(GraspTargets(good.positions, good.rotations @ turn, good.quality))
        found = torch.diagonal(compute_grasp_distances(turned, good)[0])
        torch.testing.assert_close(found, torch.full((5,), away), atol=1e-5, rtol=1e-4)


def test_points_between_the_pads_belong_to_a_grasp() -> None:
    poses = torch.tensor([[[0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], [0.0] * 7]])
    good = grasp_targets_from_poses(poses, torch.tensor([[1.0, 0.0]]))
    centers = torch.tensor([[[0.0, 0.0, 0.4], [0.0, 0.03, 0.4], [0.0, 0.06, 0.4], [0.03, 0.0, 0.4], [0.0, 0.0, 0.1]]])
    found = find_enclosed_centers(centers, good)[0]
    assert found[:, 0].tolist() == [True, True, False, False, False]
    assert not found[:, 1].any(), "padding"


def test_losses_are_least_for_what_is_good() -> None:
    good = random_targets([1.0, 0.8, 0.6, 0.0])
    sure = torch.logit(good.quality.clamp(1e-4, 1.0 - 1e-4))
    right = grasps_at(good)._replace(quality=sure)
    wrong = right._replace(positions=right.positions + 0.02, quality=-sure)
    clouds = PointCloudBatch(good.positions, NOTHING[None], torch.ones(1, 1), torch.arange(4)[None], NOTHING)
    batch = LabelledClouds(clouds, good, NOTHING, NOTHING)
    best, worse = (compute_grasp_losses(found, batch) for found in (right, wrong))
    assert best["grasp"] == pytest.approx(0.0, abs=1e-6)
    assert worse["grasp"] == pytest.approx(0.02 * 3.0**0.5, rel=1e-3)
    assert best["quality"] < worse["quality"]
    assert best["object_center"] == best["object_motion"] == 0.0
