"""Tests of the effects of the giver's action on the recorded motion of one giver and of tensors of several."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP
from handover_marl.episode.giver_motion import (
    NEVER,
    NO_DEVIATION,
    GiverMotion,
    compute_wrist_in_base,
    count_steps_until_pick_up,
    find_pick_up_frame,
    requests_release,
)
from handover_marl.episode.wrist_offset import move_with_wrists, track_set_points
from handover_marl.geometry.arrays import ArrayFactory, make_tensor_factory
from handover_marl.geometry.kinematic_tree import compute_link_trajectory, read_tree
from handover_marl.simulation.reference_tracking import WRIST_LINK, ReferenceMotion
from tests.episode.one_giver import CONFIG, COUNT, HIGH, SCENES, OneGiver

SCENE = SCENES[0]


def playback() -> OneGiver:
    return OneGiver(SCENE)


def advance(played: OneGiver, steps: int, wanted: np.ndarray = NO_DEVIATION, **states: bool) -> ReferenceMotion:
    motion = played.plan(steps, wanted, **states)
    played.commit(steps)
    return motion


def action(rate: float = 0.0, shift: tuple[float, ...] = (0, 0, 0), turn: tuple[float, ...] = (0, 0, 0)) -> np.ndarray:
    return np.array([rate, *shift, *turn, 0.0], dtype=np.float32)


def pose(dof: np.ndarray) -> tuple[np.ndarray, Rotation]:
    return dof[..., :3].astype(float), Rotation.from_euler("XYZ", dof[..., 3:6].astype(float))


def wrist(motion: ReferenceMotion) -> np.ndarray:
    positions, turns = pose(motion.hand)
    return np.asarray(positions + turns.apply(compute_wrist_in_base(read_tree(SCENE.assets.hand))))


def held(steps: int = SCENE.n_frames) -> OneGiver:
    """Return a playback in which the object has been lifted and, by default, all motion has ended."""
    played = playback()
    advance(played, steps)
    assert played.holding
    return played


def test_zero_is_the_recording_to_the_bit() -> None:
    played, pieces = playback(), []
    for steps in (1, 99, 100, 37, SCENE.n_frames):
        pieces.append(advance(played, steps))
    rows = np.minimum(np.arange(1, 238 + SCENE.n_frames), SCENE.n_frames - 1)
    np.testing.assert_array_equal(np.concatenate([piece.objects for piece in pieces]), SCENE.object_dof[rows])
    hand, present = np.concatenate([piece.hand for piece in pieces]), SCENE.is_hand_present(rows)
    np.testing.assert_array_equal(hand[present], SCENE.hand_dof[rows][present])
    assert not NO_DEVIATION.any()
    assert not NO_DEVIATION.flags.writeable
    np.testing.assert_array_equal(requests_release(np.repeat([[0.0], [0.5], [0.6], [1.0]], 8, axis=1)), [0, 0, 1, 1])


def test_a_reset_starts_at_the_first_frame() -> None:
    played, scene = held(), replace(SCENE, hand_first=1)
    first = played.motion.reset(0, scene)
    np.testing.assert_array_equal(first.objects, scene.object_dof[:1])
    np.testing.assert_array_equal(first.hand, scene.hand_dof[:1])
    assert first.hand_present.tolist() == [False]
    *state, angles = (values[0] for values in played.motion.state)
    assert not any(values.any() for values in state)
    np.testing.assert_array_equal(angles, [scene.hand_dof[0, 3:6], scene.object_dof[0, 0, 3:]])


@pytest.mark.slow
@settings(max_examples=10)
@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 3).filter(lambda shift: np.linalg.norm(shift) > 1e-3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3),
)
def test_hand_and_object_move_as_one_about_the_wrist(shift: tuple[float, ...], turn: tuple[float, ...]) -> None:
    played = held()
    before = advance(played, 1)
    after = advance(played, 3000, action(shift=shift, turn=turn))
    change = Rotation.from_rotvec(np.float32(turn))
    np.testing.assert_allclose(wrist(after)[-1], wrist(before)[-1] + shift, atol=2e-6)
    for old, new in ((before.hand, after.hand), (before.objects[:, 0], after.objects[:, 0])):
        (old_place, old_turn), (new_place, new_turn) = pose(old[-1]), pose(new[-1])
        assert (new_turn * (change * old_turn).inv()).magnitude() < 1e-5
        arm = change.apply(old_place - wrist(before)[-1])
        np.testing.assert_allclose(new_place, wrist(after)[-1] + arm, atol=2e-6)
    np.testing.assert_array_equal(after.hand[:, 6:], np.tile(before.hand[-1, 6:], (3000, 1)))
    np.testing.assert_array_equal(after.objects[:, 1:], np.tile(before.objects[-1, 1:], (3000, 1, 1)))


@pytest.mark.slow
def test_deviations_come_at_a_human_pace_and_without_jumps() -> None:
    played = held()
    rows = [advance(played, 1)]
    for turn in ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (0, 0, 0)):
        rows.append(advance(played, 1500, action(shift=(0.3, -0.3, 0.3), turn=turn)))
    moved = np.concatenate([wrist(motion) for motion in rows])
    assert np.linalg.norm(np.diff(moved, axis=0), axis=1).max() <= CONFIG.speed * 0.001 + 1e-6
    np.testing.assert_array_equal(played.motion.state.angles[0], [rows[-1].hand[-1, 3:6], rows[-1].objects[-1, 0, 3:]])
    for part in ("hand", "objects"):
        dof = np.concatenate([getattr(motion, part).reshape(len(motion.hand), -1)[:, :6] for motion in rows])
        _, turns = pose(dof)
        steps = (turns[1:] * turns[:-1].inv()).magnitude()
        assert steps.max() < 0.01
        assert np.abs(np.diff(dof[:, 3:], axis=0)).max() < 0.5, "angles go on without a jump of a turn"


def test_the_object_deviates_from_the_pick_up_on_however_steps_are_divided() -> None:
    lift, displaced = find_pick_up_frame(SCENE), action(shift=(0.2, 0, 0))
    at_once, in_parts = playback(), playback()
    for played in (at_once, in_parts):
        advance(played, lift - 60)
        assert not played.holding
        # Nothing deviates if the object is picked up with the last of the steps.
        np.testing.assert_array_equal(advance(played, 10, displaced).objects, SCENE.object_dof[lift - 59 : lift - 49])
    until = at_once.plan(50, displaced)
    np.testing.assert_array_equal(until.objects, SCENE.object_dof[lift - 49 : lift + 1])
    at_once.commit(49)
    assert not at_once.holding
    assert not at_once.motion.state.has_deviated[0]
    around = advance(at_once, 51, displaced)
    np.testing.assert_allclose(around.objects[:1], SCENE.object_dof[lift : lift + 1], atol=1e-6)
    assert around.objects[-1, 0, 0] > SCENE.object_dof[lift + 50, 0, 0] + 0.001
    parts = [advance(in_parts, steps, displaced) for steps in (49, 1)]
    assert in_parts.holding, "the frame of the pick-up is played"
    parts += [advance(in_parts, steps, displaced) for steps in (6, 44)]
    np.testing.assert_allclose(np.concatenate([part.objects for part in parts])[49:], around.objects, atol=1e-6)
    np.testing.assert_array_equal(
        advance(in_parts, 1, displaced, released=True).objects[0], SCENE.object_dof[lift + 51]
    )


def test_angles_continue_without_a_jump_near_gimbal_lock() -> None:
    """Bodies keep their rotation, and their angles are those nearest to the angles of the step before."""
    turns = np.linspace(0.0, 6.0, 300)
    bodies = np.zeros((1, len(turns), 2, 6), dtype=np.float32)
    bodies[..., 4] = 1.45
    offsets = np.zeros((1, len(turns), 2, 3))
    offsets[0, :, 1, 0], offsets[0, :, 1, 1] = 0.2 * np.sin(turns), turns
    moved = move_with_wrists(bodies, offsets, np.zeros((1, 3)), bodies[:, 0, :, 3:])[0, :, 0]
    expected = Rotation.from_rotvec(offsets[0, :, 1]) * Rotation.from_euler("XYZ", bodies[0, :, 0, 3:])
    assert (pose(moved)[1] * expected.inv()).magnitude().max() < 1e-5
    both = np.stack([moved[1:, 3:], np.pi + moved[1:, 3:] * [1, -1, 1]], axis=1).astype(float)
    before = moved[:-1, None, 3:]
    both += 2 * np.pi * np.round((before - both) / (2 * np.pi))
    distances = np.abs(both - before).sum(axis=2)
    chosen = np.abs(moved[1:, 3:] - moved[:-1, 3:]).sum(axis=1)
    np.testing.assert_allclose(chosen, distances.min(axis=1), atol=1e-5)
    assert np.abs(np.diff(expected.as_euler("XYZ"), axis=0)).max() > 3.0, "other angles of these rotations jump"


def test_the_preview_shows_what_comes() -> None:
    preview = playback().preview
    ahead = np.array([100, 200, 300, 400, 500])
    seen = preview(1000)[1]
    place, turn = pose(SCENE.object_dof[1000 + ahead, 0])
    np.testing.assert_allclose(seen[:, :3], place, atol=1e-6)
    assert (Rotation.from_quat(seen[:, 3:]) * turn.inv()).magnitude().max() < 1e-5
    np.testing.assert_array_equal(preview(10**6)[0], np.tile(preview(10**6)[0][0], (5, 1)))
    wrists = compute_link_trajectory(SCENE.assets.hand, SCENE.hand_dof[1000 + ahead].astype(float))[0][:, WRIST_LINK]
    np.testing.assert_allclose(preview(1000)[0][:, :3], wrists, atol=1e-6)


def test_the_preview_has_zeros_without_a_hand() -> None:
    preview = OneGiver(replace(SCENE, hand_last=1250)).preview
    wrists, objects = preview(1000)
    assert (np.abs(wrists).max(axis=1) > 0).tolist() == [True, True, False, False, False]
    assert (np.abs(objects).max(axis=1) > 0).all()


def test_a_held_object_does_not_jump_when_the_recorded_hand_leaves() -> None:
    hand_dof, last = SCENE.hand_dof.copy(), find_pick_up_frame(SCENE) + 300
    hand_dof[last + 1 :] = 0.0
    played = OneGiver(replace(SCENE, hand_dof=hand_dof, hand_last=last))
    path = advance(played, last + 300, action(turn=(0, 0, 0.5))).objects[:, 0, :3]
    assert np.abs(np.diff(path, axis=0)).max() < 0.002


def seen(played: OneGiver) -> tuple[object, ...]:
    return played.frame, played.holding, played.opening_progress, played.deviation.tolist()


#: Frame in which the object has been picked up, but still moves.
LIFTED = find_pick_up_frame(SCENE) + 100


@settings(max_examples=10)
@given(st.integers(1, 99), st.floats(-1.0, 1.0))
def test_only_what_was_simulated_counts(done: int, rate: float) -> None:
    """Steps that were planned but not simulated have no effect on the playback."""
    wanted = action(rate=rate, shift=(0.1, -0.2, 0.05), turn=(0.3, 0.0, -0.5))
    whole, cut = held(LIFTED), held(LIFTED)
    planned = whole.plan(100, wanted, is_opening=True)
    whole.commit(done)
    short = advance(cut, done, wanted, is_opening=True)
    np.testing.assert_array_equal(planned.hand[:done], short.hand)
    np.testing.assert_array_equal(planned.objects[:done], short.objects)
    assert seen(whole) == seen(cut)
    assert 0.0 < whole.opening_progress < 1.0
    np.testing.assert_array_equal(advance(whole, 50).hand, advance(cut, 50).hand)


@pytest.mark.parametrize("rate", [-1.0, 1.0])
def test_how_steps_are_cut_does_not_matter(rate: float) -> None:
    """The motion of a pausing or hurrying giver does not depend on the number of steps per control period."""
    whole = held(LIFTED)
    planned = np.concatenate([advance(whole, 100, action(rate=rate)).hand for _ in range(3)])
    for length in (1, 10, 20, 50):
        cut = held(LIFTED)
        parts = [advance(cut, length, action(rate=rate)).hand for _ in range(300 // length)]
        np.testing.assert_array_equal(planned, np.concatenate(parts))
        assert seen(whole) == seen(cut)


def test_the_object_is_picked_up_beyond_five_millimeters() -> None:
    dof = np.zeros((4, 1, 6), dtype=np.float32)
    for path, expected in (([0, 4, 6, 8], 2), ([0, 6, 0, 0], 1), ([0, 4, 5, 4], NEVER), ([0, -6, 0, 0], 1)):
        moved = dof.copy()
        moved[:, 0, 1] = np.array(path) / 1000
        assert find_pick_up_frame(replace(SCENE, object_dof=moved)) == expected
    moved = dof.copy()
    moved[1:, 0, 1] = 0.25, 0.25, 0.5
    assert find_pick_up_frame(replace(SCENE, object_dof=moved), 0.25) == 3, "not at the distance itself"
    counts = count_steps_until_pick_up(np.array([5, 9]), np.array([3, 3]), np.array([[4, 5, 6], [3, 3, 3]]))
    assert counts.tolist() == [2, 3], "the step from the frame itself moves the object"


@settings(max_examples=20)
@example([(1.0, 300), (1.0, 100), (0.0, 300), (0.0, 10)])
@example([(-1.0, 300), (-1.0, 10), (0.3, 100), (0.0, 100), (0.0, 300), (0.25, 300), (0.25, 7), (0.0, 60)])
@given(st.lists(st.tuples(st.floats(-1.0, 1.0) | st.sampled_from([0.0, 0.5, -0.5, 1.0]), st.integers(1, 300))))
def test_frames_follow_the_rates(parts: list[tuple[float, int]]) -> None:
    """Rates change by at most 5/s; a frame is the rounded sum of the speeds so far."""
    played, rate, clock = playback(), 0.0, 0.0
    for target, steps in parts:
        target = float(np.float32(target))
        frames = []
        start = rate
        for number in range(1, steps + 1):
            change = np.clip(target - start, -0.005 * number, 0.005 * number)
            rate = target if abs(change) >= abs(target - start) else start + change
            clock += 1.0 + rate
            frames.append(min(round(round(clock, 9)), SCENE.n_frames - 1))
        motion = advance(played, steps, action(rate=target))
        np.testing.assert_array_equal(motion.objects, SCENE.object_dof[frames])
        np.testing.assert_array_equal(motion.hand_present, SCENE.is_hand_present(np.array(frames)))
        assert played.frame == frames[-1]
        assert played.deviation[0] == np.float32(rate)


def test_an_opening_hand_opens_evenly() -> None:
    played = held()
    before = advance(played, 1).hand[0]
    parts = [advance(played, steps, released=True, is_opening=True) for steps in (100, 50, 350)]
    opened = np.minimum(np.arange(1, 501) / 300.0, 1.0)
    fingers = np.concatenate([part.hand[:, 6:] for part in parts])
    np.testing.assert_allclose(fingers, (1.0 - CONFIG.opening * opened[:, None]) * before[6:], atol=1e-6)
    np.testing.assert_array_equal(np.concatenate([part.hand[:, :6] for part in parts]), np.tile(before[:6], (500, 1)))


components = st.floats(-0.5, 0.5)
SPEED, ACCELERATION = 0.8, 5.0
LIMITS = np.array([[SPEED, 2.5], [ACCELERATION, 15.0]])


def track(*targets: tuple[npt.ArrayLike, int]) -> np.ndarray:
    """Return the values (n, 3) while several set points are tracked in turn."""
    value, velocity, parts = np.zeros((1, 2, 3)), np.zeros((1, 2, 3)), [np.zeros((0, 3))]
    for set_point, steps in targets:
        goals = np.tile(np.array(set_point, dtype=float), (1, 2, 1))
        values, velocities = track_set_points(value, velocity, goals, steps, LIMITS)
        value, velocity = values[:, -1], velocities[:, -1]
        parts.append(values[0, :, 0])
    return np.concatenate(parts)


@pytest.mark.slow
@given(st.lists(st.tuples(st.tuples(components, components, components), st.integers(1, 300)), max_size=4))
def test_speed_and_acceleration_are_limited(targets: list[tuple[tuple[float, float, float], int]]) -> None:
    values = np.concatenate([np.zeros((2, 3)), track(*targets)])
    velocity = np.diff(values, axis=0) / TIME_STEP
    assert np.linalg.norm(velocity, axis=1).max(initial=0.0) <= SPEED + 1e-9
    # On arrival, the value is set to the goal, a change of less than a micrometer.
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / TIME_STEP
    assert acceleration.max(initial=0.0) <= ACCELERATION + 1.1


@pytest.mark.slow
@given(st.tuples(components, components, components))
def test_the_set_point_is_reached_exactly_and_kept(goal: tuple[float, float, float]) -> None:
    np.testing.assert_array_equal(track((goal, 2500))[-200:], np.tile(goal, (200, 1)))


def test_there_is_no_overshoot() -> None:
    values = track(([0.2, 0.0, 0.0], 1000))
    assert values[:, 0].max() <= 0.2 + 2e-6
    assert values[-1, 0] == 0.2


def test_the_number_of_steps_per_call_does_not_matter() -> None:
    goal = [0.1, -0.2, 0.05]
    np.testing.assert_array_equal(track((goal, 300)), track(*((goal, n) for n in (1, 99, 7, 193))))


def test_an_offset_that_passes_its_set_point_returns() -> None:
    value, velocity = np.array([[[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]]), np.array([[[0.5, 0.0, 0.0], [0.0, 0.0, -1.0]]])
    path, speeds = track_set_points(value, velocity, value, 1000, LIMITS)
    assert np.abs(path - value[:, None]).max() > 0.01
    np.testing.assert_array_equal(path[:, -1], value)
    assert not speeds[:, -1].any()


@pytest.fixture(scope="module")
def tensors() -> ArrayFactory:
    pytest.importorskip("torch", reason="needs the extra `train`")
    return make_tensor_factory("cpu")


def start(tensors: ArrayFactory) -> tuple[GiverMotion, list[OneGiver]]:
    batch = GiverMotion(COUNT, CONFIG, tensors)
    for row, scene in enumerate(SCENES):
        batch.reset(row, scene)
    return batch, [OneGiver(scene) for scene in SCENES]


def compare(
    tensors: ArrayFactory, batch: GiverMotion, singles: list[OneGiver], rng: np.random.Generator, actions: np.ndarray
) -> None:
    """Plan and commit some steps, with random releases of the objects, and compare every value with single givers."""
    steps = int(rng.integers(1, 201))
    released = rng.random(COUNT) < 0.3
    opening = released & (rng.random(COUNT) < 0.5)
    plan = batch.plan(tensors.arange(COUNT), steps, *map(tensors.asarray, (actions, released, opening)))
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
    batch.commit(plan, tensors.asarray(taken))
    np.testing.assert_array_equal(batch.state.frame, [single.frame for single in singles])
    np.testing.assert_array_equal(batch.holding, [single.holding for single in singles])
    np.testing.assert_allclose(batch.deviation, [single.deviation for single in singles], atol=1e-7)
    np.testing.assert_allclose(
        batch.state.opening_progress, [single.opening_progress for single in singles], rtol=0, atol=1e-12
    )


@pytest.mark.slow
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_random_actions_give_equal_motions_of_tensors(tensors: ArrayFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    batch, singles = start(tensors)
    actions = np.zeros((COUNT, 8), dtype=np.float32)
    for number in range(14):
        if number % 3 == 0:
            actions = rng.uniform(-1.0, 1.0, (COUNT, 8)).astype(np.float32) * HIGH
            actions[rng.random(COUNT) < 0.3] = NO_DEVIATION
        compare(tensors, batch, singles, rng, actions)


def test_previews_of_tensors_are_those_of_single_givers(tensors: ArrayFactory) -> None:
    batch, singles = start(tensors)
    for frames in ([0, 0, 0, 0], [700, 3, 1500, 10], [scene.n_frames - 1 for scene in SCENES]):
        batch.state.frame[:] = tensors.asarray(frames)
        wrists, objects = batch.read_previews(tensors.arange(COUNT))
        for row, (single, frame) in enumerate(zip(singles, frames, strict=True)):
            expected = single.preview(frame)
            np.testing.assert_allclose(wrists[row], expected[0], atol=1e-6)
            np.testing.assert_allclose(objects[row], expected[1], atol=1e-6)
