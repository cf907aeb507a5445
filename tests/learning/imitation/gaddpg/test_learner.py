"""Tests of training GA-DDPG's network: augmented states, losses and resuming."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.learning.imitation.gaddpg.data_generation import ImitationStates  # noqa: E402
from handover_marl.learning.imitation.gaddpg.training import (  # noqa: E402
    GaddpgLearner,
    ImitationBatches,
    compute_action_losses,
    compute_goal_losses,
)
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork  # noqa: E402


def draw_states() -> ImitationStates:
    """Return states of four clouds: the points, then some of them again."""
    rng, goals, clouds = np.random.default_rng(0), [], []
    for count, size in ((3, 0.05), (40, 0.1), (700, 0.03), (1024, 0.12)):
        points = rng.uniform(-size, size, (count, 3)) + np.array([0.0, 0.0, 0.3])
        clouds.append(points[np.r_[:count, rng.integers(count, size=1024 - count)]])
        goals.append([*rng.uniform(-0.1, 0.3, 3), *Rotation.random(random_state=0).as_quat()])
    return ImitationStates(np.float16(clouds), np.float32(goals), np.full(4, 9, np.int32))


def test_augmented_states_are_the_same_ones_from_another_pose_of_the_hand() -> None:
    """Distances between points and grasp remain, and the expert's step follows from the changed counter."""
    batches, numbers = ImitationBatches(draw_states()), np.arange(4)
    stored, moved = (batches.select(numbers, rng) for rng in (None, np.random.default_rng(0)))
    for one in (stored, moved):
        assert [part.shape for part in one] == [(4, 4, 1024), (4,), (4, 6), (4, 7)]
        assert not one.clouds[:, 3].any()
    ranges = [(one.clouds[:, :3] - one.goals[:, :3, None]).norm(dim=1) for one in (stored, moved)]
    torch.testing.assert_close(*ranges, atol=1e-5, rtol=0.0)
    assert (stored.goals - moved.goals)[:, :3].norm(dim=1).min() > 1e-3
    assert set(stored.remaining.tolist()) == {9.0}
    assert set(moved.remaining.tolist()) <= set(range(1, 21))


def test_losses_are_in_meters_and_goals_equal_up_to_a_rotation_by_pi() -> None:
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
    threads, batches = torch.get_num_threads(), ImitationBatches(draw_states())
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
