"""Tests of the motion of several givers at once, which equals the motion of each giver alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.config import OFFICIAL_CONFIG, GiverConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.batch.giver_motion import GiverMotionBatch
from handover_marl.episode.batch.wrist_offset import track_set_points
from handover_marl.episode.giver_motion import NO_DEVIATION, Playback
from handover_marl.episode.wrist_offset import TrackedVector, track_set_point

CONFIG = OFFICIAL_CONFIG.giver
SCENES = [SyntheticDataset().load_scene(number) for number in (209, 5, 31, 87)]
COUNT = len(SCENES)
ROWS = np.arange(COUNT)
HIGH = np.array([1.0, *[CONFIG.displacement] * 3, *[CONFIG.rotation] * 3, 1.0], dtype=np.float32)


def start(config: GiverConfig = CONFIG) -> tuple[GiverMotionBatch, list[Playback]]:
    batch = GiverMotionBatch(COUNT, config)
    for row, scene in enumerate(SCENES):
        batch.reset(row, scene)
    return batch, [Playback(scene, config) for scene in SCENES]


def compare(batch: GiverMotionBatch, singles: list[Playback], rng: np.random.Generator, actions: np.ndarray) -> None:
    """Plan and commit some steps, with random releases of the objects, and compare every value with single givers."""
    steps = int(rng.integers(1, 201))
    released = rng.random(COUNT) < 0.3
    opening = released & (rng.random(COUNT) < 0.5)
    motion = batch.plan(ROWS, steps, actions, released, opening)
    taken = np.where(rng.random(COUNT) < 0.8, steps, rng.integers(0, steps + 1, COUNT))
    for row, single in enumerate(singles):
        expected = single.plan(steps, actions[row], bool(released[row]), bool(opening[row]))
        found = motion.references[row]
        np.testing.assert_array_equal(found.hand, expected.hand, strict=True)
        np.testing.assert_array_equal(found.objects, expected.objects, strict=True)
        np.testing.assert_array_equal(found.hand_present, expected.hand_present)
        single.commit(int(taken[row]))
    batch.commit(motion, taken)
    np.testing.assert_array_equal(batch.frame, [single.frame for single in singles])
    np.testing.assert_array_equal(batch.holding, [single.holding for single in singles])
    # Values that are zero but for rounding need not have equal bits.
    np.testing.assert_allclose(batch.deviation, [single.deviation for single in singles], rtol=2e-7, atol=1e-12)
    np.testing.assert_allclose(
        batch.opening_progress, [single.opening_progress for single in singles], rtol=0, atol=1e-15
    )


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_random_actions_give_equal_motions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    batch, singles = start()
    actions = np.zeros((COUNT, 8), dtype=np.float32)
    for number in range(16):
        if number % 3 == 0:
            actions = rng.uniform(-1.0, 1.0, (COUNT, 8)).astype(np.float32) * HIGH
            actions[rng.random(COUNT) < 0.3] = NO_DEVIATION
        compare(batch, singles, rng, actions)


def test_a_motion_does_not_depend_on_the_other_givers() -> None:
    rng = np.random.default_rng(0)
    together, _ = start()
    alone, _ = start()
    held = np.zeros(COUNT, dtype=bool)
    for _ in range(12):
        actions = rng.uniform(-1.0, 1.0, (COUNT, 8)).astype(np.float32) * HIGH
        motion = together.plan(ROWS, 150, actions, held, held)
        single = alone.plan(ROWS[1:2], 150, actions[1:2], held[1:2], held[1:2])
        np.testing.assert_array_equal(motion.references[1].hand, single.references[0].hand)
        np.testing.assert_array_equal(motion.references[1].objects, single.references[0].objects)
        together.commit(motion, np.full(COUNT, 150))
        alone.commit(single, np.array([150]))


def test_a_reset_forgets_the_deviation() -> None:
    batch, _ = start()
    actions = np.tile(HIGH, (COUNT, 1))
    held = np.zeros(COUNT, dtype=bool)
    for _ in range(20):
        batch.commit(batch.plan(ROWS, 200, actions, held, held), np.full(COUNT, 200))
    assert batch.deviation[:, 1:4].all()
    first = batch.reset(0, SCENES[0])
    np.testing.assert_array_equal(first.hand, SCENES[0].hand_dof[:1])
    assert not batch.deviation[0].any()
    assert batch.deviation[1:].any(axis=1).all()


@pytest.mark.parametrize("distance", [1e-8, 1e-3, 0.3])
def test_set_points_are_tracked_as_by_one_giver(distance: float) -> None:
    limits = np.array([[0.8, 2.5], [5.0, 15.0]])
    goal = np.array([[[distance, -distance, 0.5 * distance], [0.0, distance, distance]]])
    path, speeds = track_set_points(np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), goal, 1500, limits)
    for part in range(2):
        values, last = track_set_point(TrackedVector(), goal[0, part], 1500, limits[0, part], limits[1, part])
        np.testing.assert_allclose(path[:, 0, part], values, rtol=0, atol=1e-12)
        assert last.value == tuple(path[-1, 0, part])
    np.testing.assert_array_equal(path[-1], goal)
    assert not speeds[-1].any()


def test_an_offset_that_passes_its_set_point_returns() -> None:
    limits = np.array([[0.8, 2.5], [5.0, 15.0]])
    value, velocity = np.array([[[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]]), np.array([[[0.5, 0.0, 0.0], [0.0, 0.0, -1.0]]])
    path, speeds = track_set_points(value, velocity, value, 1000, limits)
    for part in range(2):
        start = TrackedVector(tuple(value[0, part]), tuple(velocity[0, part]))
        values, _ = track_set_point(start, value[0, part], 1000, limits[0, part], limits[1, part])
        np.testing.assert_allclose(path[:, 0, part], values, rtol=0, atol=1e-12)
    assert np.abs(path - value).max() > 0.01
    np.testing.assert_array_equal(path[-1], value)
    assert not speeds[-1].any()


def test_givers_at_rest_and_single_steps_equal_those_of_one_giver() -> None:
    batch, singles = start()
    rng = np.random.default_rng(3)
    actions = (rng.uniform(0.3, 1.0, (COUNT, 8)) * rng.choice([-1.0, 1.0], (COUNT, 8))).astype(np.float32) * HIGH
    actions[:, 0] = 0.0
    held = np.zeros(COUNT, dtype=bool)
    for steps in [200, 1, 1] * 45:
        motion = batch.plan(ROWS, steps, actions, held, held)
        for row, single in enumerate(singles):
            expected = single.plan(steps, actions[row])
            np.testing.assert_array_equal(motion.references[row].hand, expected.hand)
            np.testing.assert_array_equal(motion.references[row].objects, expected.objects)
            single.commit(steps)
        batch.commit(motion, np.full(COUNT, steps))
        # Values that are zero but for rounding need not have equal bits.
    np.testing.assert_allclose(batch.deviation, [single.deviation for single in singles], rtol=2e-7, atol=1e-12)
    assert batch.holding.all()
    # On the way, the Euler angles of bodies have taken several solutions and full turns.
    np.testing.assert_array_equal(batch.deviation[:, 1:], actions[:, 1:7])
