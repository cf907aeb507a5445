"""Tests of how GA-DDPG's network acts: by its predicted action, or by a rule that approaches its predicted grasp."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.learning.networks.approach_field import ApproachFieldConfig, compute_approach_steps  # noqa: E402
from handover_marl.learning.networks.gaddpg_network import ActorOutput, GaddpgNetwork  # noqa: E402
from handover_marl.learning.networks.weights import read_network_weights, write_network_weights  # noqa: E402

RULE = replace(ApproachFieldConfig(), standoff=0.07)
HERE = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def cloud() -> np.ndarray:
    points = np.zeros((4, 1030))
    points[:3] = np.random.default_rng(0).uniform(0.1, 0.3, (3, 1030))
    points[3, :6] = 1.0
    return points


def network(approach: ApproachFieldConfig | None) -> GaddpgNetwork:
    torch.manual_seed(0)
    return GaddpgNetwork(approach).eval()


def test_it_goes_to_the_grasp_that_it_reports(cloud: np.ndarray) -> None:
    by_goal, by_action = network(RULE), network(None)
    with torch.no_grad():
        reported: ActorOutput = by_goal(torch.from_numpy(cloud.astype(np.float32))[None], torch.tensor([7.0]))
    w, x, y, z, *place = reported.goal[0].double().tolist()
    wanted = compute_approach_steps(HERE, np.array([[*place, x, y, z, w]]), np.array([7.0]), RULE)[0]
    np.testing.assert_allclose(by_goal.predict_step(cloud, 7), wanted, atol=1e-5)
    np.testing.assert_allclose(by_action.predict_step(cloud, 7), reported.action[0].numpy(), atol=1e-5)
    assert np.abs(by_goal.predict_step(cloud, 7) - by_action.predict_step(cloud, 7)).max() > 1e-3


def test_many_clouds_are_decided_on_as_one_by_one(cloud: np.ndarray) -> None:
    clouds, left = np.stack([cloud, cloud[:, ::-1].copy(), 0.7 * cloud]), np.array([3.0, 9.0, 20.0])
    for approach in (RULE, None):
        decides = network(approach)
        single = [decides.predict_step(one, int(count)) for one, count in zip(clouds, left, strict=True)]
        np.testing.assert_allclose(decides.predict_steps(clouds, left), single, atol=1e-5)


@pytest.mark.parametrize("approach", [RULE, None])
def test_files_know_the_rule(approach: ApproachFieldConfig | None, cloud: np.ndarray, tmp_path: Path) -> None:
    write_network_weights(tmp_path / "policy.npz", network(approach), {})
    found, _ = read_network_weights(tmp_path / "policy.npz", GaddpgNetwork)
    assert found.approach == approach
    np.testing.assert_allclose(found.predict_step(cloud, 7), network(approach).predict_step(cloud, 7), atol=2e-3)
    for name, value in network(approach).state_dict().items():
        # Weights are rounded to 8 bits, relative to the largest of their row; vectors to half precision.
        step = 0.5 * value.abs().amax(dim=tuple(range(1, value.ndim)), keepdim=True) / 127 if value.ndim > 1 else 0.0
        assert ((found.state_dict()[name] - value).abs() <= step + 5e-4 * value.abs() + 1e-7).all(), name
    about = json.loads(str(np.load(tmp_path / "policy.npz")["about"]))
    assert (about["settings"]["approach"] is None) == (approach is None)
    kept = np.load(tmp_path / "policy.npz")
    assert kept["features.dense.0.weight"].dtype == np.int8
    assert (tmp_path / "policy.npz").stat().st_size < 2_000_000
