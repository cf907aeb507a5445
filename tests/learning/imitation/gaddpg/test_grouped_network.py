"""Tests of training GA-DDPG's network on stored groups: equality with the deployed network, losses, resuming."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.learning.imitation.gaddpg.data_generation import ImitationStates, stack_states  # noqa: E402
from handover_marl.learning.imitation.gaddpg.training import (  # noqa: E402
    GaddpgLearner,
    ImitationBatches,
    compute_action_losses,
    compute_goal_losses,
    encode_batch,
)
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork  # noqa: E402


def draw_states() -> tuple[ImitationStates, np.ndarray]:
    """Return states of four clouds, and the receiver's clouds (4, 4, 1024): the points, then some of them again."""
    rng, rows, filled = np.random.default_rng(0), [], np.zeros((4, 4, 1024), dtype=np.float32)
    for number, (count, size) in enumerate(((3, 0.05), (40, 0.1), (700, 0.03), (1024, 0.12))):
        points = (rng.uniform(-size, size, (count, 3)) + np.array([0.0, 0.0, 0.3])).astype(np.float16)
        goal = np.array([*rng.uniform(-0.1, 0.3, 3), *Rotation.random(random_state=0).as_quat()])
        rows.append((points, goal, 9))
        filled[number, :3] = points[np.r_[:count, rng.integers(count, size=1024 - count)]].T
    return stack_states(rows), filled


def test_grouped_network_equals_the_network() -> None:
    states, clouds = draw_states()
    torch.manual_seed(0)
    network = GaddpgNetwork().eval()
    for module in network.modules():
        if isinstance(module, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            module.running_mean.normal_(0.0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    with torch.no_grad():
        whole = network(torch.from_numpy(clouds), torch.full((4,), 9.0))
        batch = ImitationBatches(states, max_neighbors=64).select(np.arange(4), None)
        grouped = network.policy(encode_batch(network.features, batch), batch.remaining)
    torch.testing.assert_close(grouped.action, whole.action, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(grouped.goal, whole.goal, atol=1e-5, rtol=1e-4)


def test_losses_are_in_metres_and_goals_equal_up_to_a_rotation_by_pi() -> None:
    turn, place = Rotation.random(random_state=0), [0.1, -0.2, 0.3]
    reported = torch.tensor(np.array([[*turn.as_quat()[[3, 0, 1, 2]], *place]])).float()
    for other in (turn, turn * Rotation.from_euler("z", np.pi)):
        assert float(compute_goal_losses(reported, torch.tensor(np.array([[*place, *other.as_quat()]])).float())) < 1e-5
    steps = torch.tensor([[0.01, 0.0, -0.02, 0.3, -0.2, 0.1]])
    moved = steps + torch.tensor([[0.01, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert float(compute_action_losses(steps, steps)) == 0.0
    assert float(compute_action_losses(moved, steps)) == pytest.approx(0.01, rel=1e-4)


@pytest.mark.slow
def test_resumed_learner_continues_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, (states, _) = torch.get_num_threads(), draw_states()
    batches = ImitationBatches(states)
    monkeypatch.setattr(GaddpgLearner, "use_bfloat16", False)
    monkeypatch.setattr(GaddpgLearner, "warmup", 1)

    def make_learner(seed: int) -> GaddpgLearner:
        torch.manual_seed(seed)
        return GaddpgLearner(GaddpgNetwork(), 8, torch.device("cpu"))

    def learn(learner: GaddpgLearner, first: int, last: int) -> list[dict[str, float]]:
        return [learner.update(batches.sample(4, np.random.default_rng(number))) for number in range(first, last)]

    torch.set_num_threads(1)  # because the rounding of several threads varies from run to run
    whole, half, rest = make_learner(0), make_learner(0), make_learner(5)
    losses = learn(whole, 0, 8)
    assert losses[-1]["action"] < losses[0]["action"]
    learn(half, 0, 5)
    rest.restore(half.get_state())
    assert learn(rest, 5, 8) == losses[5:]
    torch.set_num_threads(threads)
