"""Tests of training GA-DDPG's network on stored groups: equality with the deployed network, losses, resuming."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.learning.imitation.gaddpg.batches import ImitationBatches  # noqa: E402
from handover_marl.learning.imitation.gaddpg.learner import (  # noqa: E402  # noqa: E402
    GaddpgLearner,
    GaddpgLearnerConfig,
    compute_action_losses,
    compute_goal_losses,
    evaluate_network,
)
from handover_marl.learning.imitation.gaddpg.states import ImitationStates, stack_states  # noqa: E402
from handover_marl.learning.networks.approach_field import ApproachFieldConfig  # noqa: E402
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork  # noqa: E402


def cloud(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    points = rng.uniform(-size, size, (count, 3)) + np.array([0.0, 0.0, 0.3])
    return points.astype(np.float16)


def some_states(seed: int = 0) -> tuple[ImitationStates, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    clouds = [cloud(rng, count, size) for count, size in ((3, 0.05), (40, 0.1), (700, 0.03), (1024, 0.12))]
    goals = [np.array([*rng.uniform(-0.1, 0.3, 3), *Rotation.random(random_state=seed).as_quat()]) for _ in clouds]
    return stack_states([(points, goal, 9) for points, goal in zip(clouds, goals, strict=True)]), clouds


def filled(points: np.ndarray) -> np.ndarray:
    """Return the receiver's cloud (4, 1024): the points, and then randomly chosen points again."""
    more = np.random.default_rng(1).integers(len(points), size=1024 - len(points))
    columns = np.zeros((4, 1024), dtype=np.float32)
    columns[:3] = points[np.concatenate([np.arange(len(points)), more])].T
    return columns


def network() -> GaddpgNetwork:
    torch.manual_seed(0)
    made = GaddpgNetwork().eval()
    for module in made.modules():
        if isinstance(module, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            module.running_mean.normal_(0.0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    return made


def test_grouped_network_equals_the_network() -> None:
    states, clouds = some_states()
    batch = ImitationBatches(states, max_neighbors=64).select(np.arange(4), None)
    made = network()
    with torch.no_grad():
        shown = torch.from_numpy(np.stack([filled(points) for points in clouds]))
        whole, grouped = made(shown, torch.full((4,), 9.0)), evaluate_network(made, batch)
    torch.testing.assert_close(grouped.action, whole.action, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(grouped.goal, whole.goal, atol=1e-5, rtol=1e-4)


def test_goals_are_equal_up_to_a_rotation_by_pi() -> None:
    rng = np.random.default_rng(0)
    turn = Rotation.random(random_state=0)
    place = rng.normal(size=3)
    reported = np.array([[*turn.as_quat()[[3, 0, 1, 2]], *place]])
    for other in (turn, turn * Rotation.from_euler("z", np.pi)):
        wanted = np.array([[*place, *other.as_quat()]])
        assert float(compute_goal_losses(torch.tensor(reported).float(), torch.tensor(wanted).float())) < 1e-5


def test_action_losses_are_in_metres() -> None:
    steps = torch.tensor([[0.01, 0.0, -0.02, 0.3, -0.2, 0.1]])
    assert float(compute_action_losses(steps, steps)) == 0.0
    moved = steps + torch.tensor([[0.01, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert float(compute_action_losses(moved, steps)) == pytest.approx(0.01, rel=1e-4)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Use one thread, because the rounding of several threads varies from run to run."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_resumed_learner_continues_exactly() -> None:
    states, _ = some_states()
    batches = ImitationBatches(states)

    def make_learner(seed: int) -> GaddpgLearner:
        torch.manual_seed(seed)
        config = GaddpgLearnerConfig(use_bfloat16=False, warmup=1)
        return GaddpgLearner(GaddpgNetwork(ApproachFieldConfig()), 12, torch.device("cpu"), config)

    def learned(learner: GaddpgLearner, first: int, last: int) -> dict[str, float]:
        reported = {}
        for number in range(first, last):
            reported = learner.update(batches.sample(8, np.random.default_rng(number)))
        return reported

    whole = make_learner(0)
    before = learned(whole, 0, 1)
    after = learned(whole, 1, 12)
    assert after["action"] < before["action"]
    half, rest = make_learner(0), make_learner(5)
    learned(half, 0, 6)
    rest.restore(half.get_state())
    assert learned(rest, 6, 12) == after
