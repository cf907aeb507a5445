"""Tests of how GA-DDPG's network acts: by its predicted action, or by a rule that approaches its predicted grasp."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.geometry.poses import compose, invert_pose  # noqa: E402
from handover_marl.learning.networks.approach_field import (  # noqa: E402
    MAX_ROTATION,
    MAX_TRANSLATION,
    STANDOFF,
    compute_approach_steps,
)
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork  # noqa: E402
from handover_marl.learning.networks.weights import read_network_weights, write_network_weights  # noqa: E402

GOAL = np.array([0.4, 0.1, 0.3, *Rotation.from_euler("xyz", [2.6, 0.3, -0.4]).as_quat()])


def draw_cloud() -> np.ndarray:
    points = np.zeros((4, 1030))
    points[:3] = np.random.default_rng(0).uniform(0.1, 0.3, (3, 1030))
    points[3, :6] = 1.0
    return points


def make_network(spare_steps: int | None) -> GaddpgNetwork:
    torch.manual_seed(0)
    return GaddpgNetwork(spare_steps).eval()


def test_steps_go_to_the_predicted_grasp_for_each_of_several_clouds() -> None:
    cloud, left = draw_cloud(), np.array([3.0, 9.0, 20.0])
    clouds = np.stack([cloud, cloud[:, ::-1].copy(), 0.7 * cloud])
    by_goal, by_action = make_network(5), make_network(None)
    with torch.no_grad():
        found = by_goal(torch.from_numpy(clouds.astype(np.float32)), torch.tensor(left).float())
    goals = found.goal.double().numpy()[:, [4, 5, 6, 1, 2, 3, 0]]
    here = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (3, 1))
    wanted = compute_approach_steps(here, goals, left, 5)
    for network, expected in ((by_goal, wanted), (by_action, found.action.numpy())):
        single = [network.predict_step(one, int(count)) for one, count in zip(clouds, left, strict=True)]
        np.testing.assert_allclose(single, expected, atol=1e-5)


@pytest.mark.parametrize("spare_steps", [5, None])
def test_files_contain_the_rule_and_rounded_weights(spare_steps: int | None, tmp_path: Path) -> None:
    network, path = make_network(spare_steps), tmp_path / "policy.npz"
    write_network_weights(path, network, {})
    found, _ = read_network_weights(path, GaddpgNetwork)
    assert found.spare_steps == spare_steps
    np.testing.assert_allclose(found.predict_step(draw_cloud(), 7), network.predict_step(draw_cloud(), 7), atol=2e-3)
    for name, value in network.state_dict().items():
        # Weights are rounded to 8 bits, relative to the largest of their row; vectors to half precision.
        step = 0.5 * value.abs().amax(dim=tuple(range(1, value.ndim)), keepdim=True) / 127 if value.ndim > 1 else 0.0
        assert ((found.state_dict()[name] - value).abs() <= step + 5e-4 * value.abs() + 1e-7).all(), name
    assert np.load(path)["features.dense.0.weight"].dtype == np.int8
    assert path.stat().st_size < 2_000_000


def compute_step(offset: list[float], remaining: float = 10.0, spare_steps: int = 20) -> np.ndarray:
    """Return the step towards GOAL from a pose in its frame: position (m)."""
    hand = compose(GOAL, np.array([*offset, 0.0, 0.0, 0.0, 1.0]))
    return compute_approach_steps(hand[None], GOAL[None], np.array([remaining]), spare_steps)[0]


@pytest.mark.parametrize("seed", range(3))
def test_approaches_reach_the_grasp_with_a_lagging_arm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    offset = np.array([*rng.uniform(-0.2, 0.2, 2), -0.35, *Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_quat()])
    hand, share = compose(GOAL, offset), 0.78
    for remaining in range(20, 0, -1):
        motion = compute_approach_steps(hand[None], GOAL[None], np.array([remaining]), 20)[0]
        assert np.abs(motion[:3]).max() <= MAX_TRANSLATION + 1e-9
        assert np.abs(motion[3:]).max() <= MAX_ROTATION + 1e-9
        rotation = Rotation.from_rotvec(share * Rotation.from_euler("xyz", motion[3:]).as_rotvec())
        hand = compose(hand, np.array([*share * motion[:3], *rotation.as_quat()]))
    error = compose(invert_pose(GOAL), hand)
    assert np.linalg.norm(error[:3]) < 0.005
    assert Rotation.from_quat(error[3:]).magnitude() < 0.02


def test_approaches_stop_at_the_standoff_then_move_in() -> None:
    np.testing.assert_allclose(compute_step([0.0, 0.0, -STANDOFF]), [0.0, 0.0, STANDOFF, 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(compute_step([0.0, 0.0, -STANDOFF - 0.04])[:3], [0.0, 0.0, 0.04], atol=1e-9)
    assert compute_step([0.04, 0.0, -0.02])[2] < -0.02, "beside the grasp, the hand retreats"
    early, late = (np.linalg.norm(compute_step([0.0, 0.0, -0.3], remaining, 5)[:3]) for remaining in (20.0, 8.0))
    assert early < late <= MAX_TRANSLATION + 1e-9
