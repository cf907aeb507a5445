"""Tests of the givers' motion on tensors, which agrees with the motion of each giver alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.episode.giver_motion import NO_DEVIATION, GiverMotion
from handover_marl.geometry.arrays import make_tensor_factory
from tests.episode.one_giver import CONFIG, COUNT, HIGH, SCENES, OneGiver

pytest.importorskip("torch", reason="needs the extra `train`")

TENSORS = make_tensor_factory("cpu")
ROWS = TENSORS.arange(COUNT)


def start() -> tuple[GiverMotion, list[OneGiver]]:
    batch = GiverMotion(COUNT, CONFIG, TENSORS)
    for row, scene in enumerate(SCENES):
        batch.reset(row, scene)
    return batch, [OneGiver(scene) for scene in SCENES]


def compare(batch: GiverMotion, singles: list[OneGiver], rng: np.random.Generator, actions: np.ndarray) -> None:
    """Plan and commit some steps, with random releases of the objects, and compare every value with single givers."""
    steps = int(rng.integers(1, 201))
    released = rng.random(COUNT) < 0.3
    opening = released & (rng.random(COUNT) < 0.5)
    plan = batch.plan(ROWS, steps, *map(TENSORS.asarray, (actions, released, opening)))
    taken = np.where(rng.random(COUNT) < 0.8, steps, rng.integers(0, steps + 1, COUNT))
    for row, single in enumerate(singles):
        expected = single.plan(steps, actions[row], bool(released[row]), bool(opening[row]))
        found = plan.reference
        np.testing.assert_allclose(found.hand[row], expected.hand, rtol=0, atol=2e-6)
        np.testing.assert_array_equal(found.hand_present[row], expected.hand_present)
        count = expected.objects.shape[1]
        np.testing.assert_allclose(found.objects[row, :, :count], expected.objects, rtol=0, atol=2e-6)
        assert not found.objects[row, :, count:].any()
        single.commit(int(taken[row]))
    batch.commit(plan, TENSORS.asarray(taken))
    np.testing.assert_array_equal(batch.state.frame, [single.frame for single in singles])
    np.testing.assert_array_equal(batch.holding, [single.holding for single in singles])
    np.testing.assert_allclose(batch.deviation, [single.deviation for single in singles], atol=1e-7)
    np.testing.assert_allclose(
        batch.state.opening_progress, [single.opening_progress for single in singles], rtol=0, atol=1e-12
    )


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_random_actions_give_equal_motions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    batch, singles = start()
    actions = np.zeros((COUNT, 8), dtype=np.float32)
    for number in range(14):
        if number % 3 == 0:
            actions = rng.uniform(-1.0, 1.0, (COUNT, 8)).astype(np.float32) * HIGH
            actions[rng.random(COUNT) < 0.3] = NO_DEVIATION
        compare(batch, singles, rng, actions)


def test_previews_are_those_of_single_givers() -> None:
    batch, singles = start()
    for frames in ([0, 0, 0, 0], [700, 3, 1500, 10], [scene.n_frames - 1 for scene in SCENES]):
        batch.state.frame[:] = TENSORS.asarray(frames)
        wrists, objects = batch.read_previews(ROWS)
        for row, (single, frame) in enumerate(zip(singles, frames, strict=True)):
            expected = single.preview(frame)
            np.testing.assert_allclose(wrists[row], expected[0], atol=1e-6)
            np.testing.assert_allclose(objects[row], expected[1], atol=1e-6)
