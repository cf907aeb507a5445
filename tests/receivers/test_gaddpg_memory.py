"""What is remembered of clouds, drawn as the original scripts draw it."""

import numpy as np
import numpy.typing as npt
import pytest

from handover_marl.receivers.gaddpg_memory import FINGER_POINTS, MemoryConfig, PointMemory

Array = npt.NDArray[np.float64]


def pose(shift: tuple[float, float, float] = (0.4, 0.1, 0.5), turn: float = 0.3) -> Array:
    """A hand turned about z in the base frame."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    matrix[:3, 3] = shift
    return matrix


def cloud(count: int, seed: int = 0) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return rng.uniform((-0.05, -0.05, 0.2), (0.05, 0.05, 0.3), (count, 3)).astype(np.float32)


def in_base(points: npt.NDArray[np.float32], base_from_hand: Array) -> Array:
    return np.asarray(base_from_hand[:3, :3] @ points.T + base_from_hand[:3, [3]], dtype=np.float64)


def seeded() -> np.random.RandomState:
    return np.random.RandomState(123456)


@pytest.mark.parametrize(("count", "remaining", "kept"), [(2000, 20, 1024), (2000, 17, 877), (400, 17, 400)])
def test_a_cloud_is_thinned_more_at_each_decision(count: int, remaining: int, kept: int) -> None:
    memory = PointMemory()
    memory.remaining = remaining
    memory.see(cloud(count), pose())
    chosen = seeded().choice(count, kept, replace=False)
    np.testing.assert_array_equal(memory.cloud, in_base(cloud(count), pose())[:, chosen].astype(np.float32))
    assert len(set(chosen)) == kept


def test_the_last_cloud_replaces_the_one_before() -> None:
    memory = PointMemory()
    memory.see(cloud(300), pose())
    memory.see(cloud(50, seed=1), pose())
    assert memory.cloud.shape == (3, 50)
    before = memory.cloud.copy()
    memory.see(cloud(0), pose((0.0, 0.0, 0.0)))
    np.testing.assert_array_equal(memory.cloud, before)


def test_nothing_seen_draws_nothing() -> None:
    memory, other = PointMemory(), PointMemory()
    memory.see(cloud(0), pose())
    for one in (memory, other):
        one.see(cloud(2000), pose())
    np.testing.assert_array_equal(memory.cloud, other.cloud)


def test_points_are_float32_in_the_base_frame_unless_they_are_three() -> None:
    memory = PointMemory()
    for count, rounded in ((2, True), (3, False), (4, True)):
        memory.see(cloud(count), pose())
        assert memory.cloud.dtype == np.float64
        assert (memory.cloud == memory.cloud.astype(np.float32)).all() == rounded
        assert memory.cloud.shape == (3, count)


@pytest.mark.parametrize(
    ("moved", "remaining", "after"),
    [(0.0999, 10, 10), (0.1001, 10, 15), (0.1001, 17, 20), (0.1001, 20, 20), (0.1001, 0, 5)],
)
def test_an_object_that_moved_gives_more_decisions(moved: float, remaining: int, after: int) -> None:
    memory = PointMemory()
    memory.see(cloud(200), pose())
    memory.remaining = remaining
    memory.see(cloud(200), pose((0.4, 0.1 + moved, 0.5)))
    assert memory.remaining == after
    memory.see(cloud(200), pose((0.4, 0.1 + moved, 0.5)))
    assert memory.remaining == after, "counted from the last look"


def test_the_first_look_is_no_move() -> None:
    memory = PointMemory()
    memory.see(cloud(200), pose((5.0, 5.0, 5.0)))
    assert memory.remaining == 20


def test_the_input_is_gripper_and_cloud_in_the_present_hand_frame() -> None:
    memory = PointMemory()
    memory.see(cloud(2000), pose())
    now = pose((0.42, 0.12, 0.45), 0.5)
    points = memory.network_input(now)
    assert points.shape == (4, 1030)
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points[3], [1.0] * 6 + [0.0] * 1024)
    np.testing.assert_array_equal(points[:3, :6], FINGER_POINTS)
    exact = np.linalg.inv(now)
    hand = exact[:3, :3] @ memory.cloud + exact[:3, [3]]
    np.testing.assert_allclose(points[:3, 6:], hand, atol=2e-7)
    # The inverse pose is rounded to float32, the points are not.
    rounded = np.linalg.inv(now).astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(points[:3, 6:], rounded[:3, :3] @ memory.cloud + rounded[:3, [3]], atol=1e-8)
    assert np.abs(points[:3, 6:] - hand).max() > 1e-8
    assert (points[:3, 6:] != points[:3, 6:].astype(np.float32)).any()


def test_few_points_are_followed_by_repeats() -> None:
    memory = PointMemory()
    memory.see(cloud(300), np.eye(4))
    points = memory.network_input(np.eye(4))[:3, 6:]
    rng = seeded()
    order = rng.choice(300, 300, replace=False)
    repeats = rng.choice(300, 724)
    np.testing.assert_array_equal(points, cloud(300).T[:, order][:, [*range(300), *repeats]])


def caged_cloud(inside: int, outside: int) -> npt.NDArray[np.float32]:
    points = np.tile(np.float32([0.0, 0.0, 0.2]), (inside + outside, 1))
    points[:inside] = [0.0, 0.0, 0.085]
    return points


@pytest.mark.parametrize(("inside", "caged"), [(50, False), (51, True)])
def test_more_than_fifty_points_are_a_cage(inside: int, caged: bool) -> None:
    memory = PointMemory()
    memory.see(caged_cloud(inside, 1024 - inside), np.eye(4))
    assert memory.caged(np.eye(4)) == caged


def test_repeats_count_as_points() -> None:
    memory = PointMemory()
    memory.see(caged_cloud(10, 90), np.eye(4))
    rng = seeded()
    order = rng.choice(100, 100, replace=False)
    expected = int((np.concatenate([order, order[rng.choice(100, 924)]]) < 10).sum())
    assert expected > 50
    assert memory.caged(np.eye(4))
    exactly = PointMemory(MemoryConfig(cage_points=expected))
    exactly.see(caged_cloud(10, 90), np.eye(4))
    assert not exactly.caged(np.eye(4))


@pytest.mark.parametrize(
    ("corner", "axis", "away"),
    [(0.02, 0, 1), (-0.02, 0, -1), (0.05, 1, 1), (-0.05, 1, -1), (0.11, 2, 1), (0.06, 2, -1)],
)
def test_the_cage_is_an_open_box(corner: float, axis: int, away: int) -> None:
    for shift, caged in ((-1e-4, True), (1e-4, False)):
        points = np.tile(np.float32([0.0, 0.0, 0.085]), (1024, 1))
        points[:, axis] = corner + away * shift
        memory = PointMemory()
        memory.see(points, np.eye(4))
        assert memory.caged(np.eye(4)) == caged


def test_the_cage_is_where_the_hand_is_now() -> None:
    memory = PointMemory()
    memory.see(caged_cloud(1024, 0), np.eye(4))
    assert memory.caged(np.eye(4))
    assert not memory.caged(pose((0.0, 0.0, 0.1), 0.0))
    assert not PointMemory().caged(np.eye(4))


def test_the_test_for_a_cage_draws() -> None:
    asked, other = PointMemory(), PointMemory()
    for memory in (asked, other):
        memory.see(cloud(300), np.eye(4))
    asked.caged(np.eye(4))
    assert (asked.network_input(np.eye(4)) != other.network_input(np.eye(4))).any()


def test_episodes_begin_alike_whatever_others_draw() -> None:
    memory = PointMemory()
    memory.see(cloud(2000), pose())
    first = memory.network_input(pose())
    memory.remaining = 3
    memory.forget()
    assert memory.remaining == 20
    assert memory.cloud.shape == (3, 0)
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # type: ignore[index,union-attr]  # noqa: NPY002
    memory.see(cloud(2000), pose())
    np.testing.assert_array_equal(memory.network_input(pose()), first)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # type: ignore[index]  # noqa: NPY002
