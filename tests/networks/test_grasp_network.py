import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from handover_marl.networks.grasp_losses import GoodGrasps, belongs, distances, good_grasps, losses
from handover_marl.networks.grasp_network import PADS, GraspNetwork, GraspNetworkConfig, Grasps, Views, turns_of

SMALL = GraspNetworkConfig(points=16, group=16, whole=16, grasp=16)


def some_views(count: int = 3, seed: int = 0) -> Views:
    draw = torch.Generator().manual_seed(seed)
    return Views(
        0.05 * torch.randn(count, 64, 3, generator=draw) + torch.tensor([0.0, 0.0, 0.4]),
        0.05 * torch.randn(count, 16, 3, generator=draw) + torch.tensor([0.0, 0.1, 0.4]),
        torch.arange(16) < torch.tensor([[16], [5], [0]])[:count],
        torch.stack([torch.randperm(64, generator=draw)[:10] for _ in range(count)]),
        torch.zeros(count, 3),
    )


def network(config: GraspNetworkConfig = SMALL) -> GraspNetwork:
    torch.manual_seed(0)
    return GraspNetwork(config).eval()


def told(net: GraspNetwork, views: Views) -> Grasps:
    with torch.inference_mode():
        return net(views)


def random_poses(count: int, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    poses = np.concatenate([rng.normal(0.0, 0.1, (count, 3)), Rotation.random(count, rng).as_quat()], axis=1)
    return torch.from_numpy(poses.astype(np.float32))


def test_shapes() -> None:
    found = told(network(), some_views())
    assert found.quality.shape == (3, 10)
    assert found.places.shape == (3, 10, 3)
    assert found.turns.shape == (3, 10, 3, 3)
    assert found.middle.shape == found.motion.shape == (3, 3)


def test_order_of_points_does_not_matter() -> None:
    views, net = some_views(), network()
    order, hands = torch.randperm(64), torch.arange(15, -1, -1)
    moved = Views(
        views.objects[:, order],
        views.hands[:, hands],
        views.seen[:, hands],
        torch.argsort(order)[views.centers],
        views.velocity,
    )
    for one, other in zip(told(net, views), told(net, moved), strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-4)


def test_points_of_the_hand_that_do_not_count_do_not_matter() -> None:
    views, net = some_views(), network()
    hands = torch.where(views.seen[..., None], views.hands, torch.tensor(7.0))
    for one, other in zip(told(net, views), told(net, views._replace(hands=hands)), strict=True):
        torch.testing.assert_close(one, other)
    shown = told(net, views._replace(hands=views.hands + 0.1))
    assert not torch.allclose(shown.quality[0], told(net, views).quality[0])


def test_who_does_not_see_hands_does_not_see_them() -> None:
    views, net = some_views(), network(GraspNetworkConfig(16, 16, 16, 16, hand=False))
    for one, other in zip(told(net, views), told(net, views._replace(hands=views.hands + 0.1)), strict=True):
        torch.testing.assert_close(one, other)


def test_turns_are_rotations() -> None:
    turns = turns_of(torch.randn(50, 6, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).expand(50, 3, 3), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(torch.linalg.det(turns), torch.ones(50))


def test_poses_become_grasps() -> None:
    poses = random_poses(20)
    good = good_grasps(poses[None], torch.ones(1, 20))
    turns = Rotation.from_quat(poses[:, 3:].numpy()).as_matrix()
    np.testing.assert_allclose(good.turns[0].numpy(), turns, atol=1e-5)
    np.testing.assert_allclose(good.places[0].numpy(), poses[:, :3].numpy() + PADS * turns[:, :, 2], atol=1e-6)


def grasps_at(good: GoodGrasps) -> Grasps:
    nothing = torch.zeros(1, 3)
    return Grasps(torch.zeros(good.quality.shape), good.places, good.turns, nothing, nothing)


def test_half_a_turn_is_no_distance_and_a_quarter_is() -> None:
    poses = random_poses(5)
    good = good_grasps(poses[None], torch.ones(1, 5))
    for angle, away in ((np.pi, 0.0), (np.pi / 2, 2.0 * 0.04 * 2.0**0.5 / 3.0)):
        turn = torch.from_numpy(Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().astype(np.float32))
        turned = grasps_at(GoodGrasps(good.places, good.turns @ turn, good.quality))
        found = torch.diagonal(distances(turned, good)[0])
        torch.testing.assert_close(found, torch.full((5,), away), atol=1e-5, rtol=1e-4)


def test_points_between_the_pads_belong_to_a_grasp() -> None:
    good = good_grasps(torch.tensor([[[0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0]]]), torch.ones(1, 1))
    centers = torch.tensor([[[0.0, 0.0, 0.4], [0.0, 0.03, 0.4], [0.0, 0.06, 0.4], [0.03, 0.0, 0.4], [0.0, 0.0, 0.3]]])
    assert belongs(centers, good)[0, :, 0].tolist() == [True, True, False, False, False]
    nothing = GoodGrasps(good.places, good.turns, torch.zeros(1, 1))
    assert not belongs(centers, nothing).any()


def test_losses_are_least_for_what_is_good() -> None:
    good = good_grasps(random_poses(4)[None], torch.tensor([[1.0, 0.8, 0.6, 0.0]]))
    sure = torch.logit(good.quality.clamp(1e-4, 1.0 - 1e-4))
    right = grasps_at(good)._replace(quality=sure)
    wrong = right._replace(places=right.places + 0.02, quality=-sure)
    nothing = torch.zeros(1, 3)
    best, worse = (losses(found, good.places, good, nothing, nothing) for found in (right, wrong))
    assert best.grasp == pytest.approx(0.0, abs=1e-6)
    assert worse.grasp == pytest.approx(0.02 * 3.0**0.5, rel=1e-3)
    assert best.quality < worse.quality
    assert best.middle == best.motion == 0.0


def test_it_learns() -> None:
    views, net = some_views(), network().train()
    poses = torch.cat([views.objects[:, :20], random_poses(60)[:, 3:].reshape(3, 20, 4)], dim=-1)
    good, nothing = good_grasps(poses, torch.ones(3, 20)), torch.zeros(3, 3)
    centers = views.objects.gather(1, views.centers[..., None].expand(-1, -1, 3))
    optimizer, values = torch.optim.Adam(net.parameters(), 3e-3), []
    for _ in range(60):
        found = losses(net(views), centers, good, nothing, nothing)
        loss = 10.0 * found.grasp + found.quality + found.middle + found.motion
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        values.append(float(loss.detach()))
    assert values[-1] < 0.5 * values[0]
