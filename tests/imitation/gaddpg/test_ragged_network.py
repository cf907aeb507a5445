"""What is learned with is the network that is deployed, and losses are what they say."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.imitation.gaddpg.batches import BatchConfig, Batches  # noqa: E402
from handover_marl.imitation.gaddpg.learner import Learner, LearnerConfig  # noqa: E402
from handover_marl.imitation.gaddpg.losses import action_losses, goal_losses  # noqa: E402
from handover_marl.imitation.gaddpg.ragged_network import decide  # noqa: E402
from handover_marl.imitation.gaddpg.states import States, joined, read_states, state, write_states  # noqa: E402
from handover_marl.networks.gaddpg_network import GaddpgNetwork  # noqa: E402
from handover_marl.planning.approach import ApproachConfig  # noqa: E402

SAME = BatchConfig(shift=0.0, turn=0.0, early=0, neighbours=64)


def cloud(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    points = rng.uniform(-size, size, (count, 3)) + np.array([0.0, 0.0, 0.3])
    return points.astype(np.float16)


def some_states(seed: int = 0) -> tuple[States, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    clouds = [cloud(rng, count, size) for count, size in ((3, 0.05), (40, 0.1), (700, 0.03), (1024, 0.12))]
    goals = [np.array([*rng.uniform(-0.1, 0.3, 3), *Rotation.random(random_state=seed).as_quat()]) for _ in clouds]
    return joined([state(points, goal, 9) for points, goal in zip(clouds, goals, strict=True)]), clouds


def filled(points: np.ndarray) -> np.ndarray:
    """(4, 1024) as the receiver shows it: repeats behind the points."""
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


def test_it_says_what_the_network_says() -> None:
    states, clouds = some_states()
    batch = Batches(states, ApproachConfig(), SAME).batch(np.arange(4), None)
    made = network()
    with torch.no_grad():
        shown = torch.from_numpy(np.stack([filled(points) for points in clouds]))
        whole, ragged = made(shown, torch.full((4,), 9.0)), decide(made, batch)
    torch.testing.assert_close(ragged.action, whole.action, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(ragged.goal, whole.goal, atol=1e-5, rtol=1e-4)


def test_states_are_kept(tmp_path) -> None:
    states, _ = some_states()
    write_states(tmp_path / "states.npz", states)
    found = read_states(tmp_path / "states.npz")
    for name in vars(states):
        np.testing.assert_array_equal(getattr(found, name), getattr(states, name))


def test_goals_may_be_turned_by_half_a_turn() -> None:
    rng = np.random.default_rng(0)
    turn = Rotation.random(random_state=0)
    place = rng.normal(size=3)
    told = np.array([[*turn.as_quat()[[3, 0, 1, 2]], *place]])
    for other in (turn, turn * Rotation.from_euler("z", np.pi)):
        wanted = np.array([[*place, *other.as_quat()]])
        assert float(goal_losses(torch.tensor(told).float(), torch.tensor(wanted).float())) < 1e-5


def test_steps_are_compared_in_metres() -> None:
    steps = torch.tensor([[0.01, 0.0, -0.02, 0.3, -0.2, 0.1]])
    assert float(action_losses(steps, steps)) == 0.0
    moved = steps + torch.tensor([[0.01, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert float(action_losses(moved, steps)) == pytest.approx(0.01, rel=1e-4)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Sums of several threads round differently from run to run."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_it_learns_and_goes_on_as_it_would_have() -> None:
    states, _ = some_states()
    batches = Batches(states, ApproachConfig(), BatchConfig())

    def learned(learner: Learner, first: int, last: int) -> dict[str, float]:
        told = {}
        for number in range(first, last):
            rng = np.random.default_rng(number)
            told = learner.update(batches.batch(rng.integers(4, size=8), rng))
        return told

    config = LearnerConfig(half=False, warm=1)
    whole = Learner(12, 0, torch.device("cpu"), config, ApproachConfig())
    before = learned(whole, 0, 1)
    after = learned(whole, 1, 12)
    assert after["action"] < before["action"]
    half = Learner(12, 0, torch.device("cpu"), config, ApproachConfig())
    learned(half, 0, 6)
    rest = Learner(12, 5, torch.device("cpu"), config, ApproachConfig())
    rest.restore(half.state())
    assert learned(rest, 6, 12) == after
