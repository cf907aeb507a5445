"""Tests of the rules of release and status, for one episode step by step and for many on arrays."""

import contextlib
import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from handover_marl.config import ProtocolConfig
from handover_marl.episode.referee import EpisodeStatus, Referee, RefereeState, ReleaseReason, make_judge
from handover_marl.geometry.arrays import NUMPY_ARRAYS, to_numpy
from handover_marl.simulation.world import NO_POINTS, Contacts, RolloutContacts, RolloutEnd, find_points_in_grasp_region
from tests.helpers.tensors import make_device_tensors

CONFIG = ProtocolConfig()
INSIDE = np.array([[0.0, 0.0, 0.03]], dtype=np.float32)

GRASP = Contacts(robot_touches_object=True, finger_points=(INSIDE, INSIDE))
PUSH = Contacts(robot_touches_object=True)
ONE_FINGER = Contacts(robot_touches_object=True, finger_points=(INSIDE, NO_POINTS))
NOTHING = Contacts()
AT_GOAL = GRASP._replace(gripper_position=CONFIG.goal_center, object_height=1.25)


def releases(sequence: list[Contacts]) -> list[ReleaseReason | None]:
    """Return the reason of the release in each step; the counters continue after a release."""
    referee, reasons = Referee(CONFIG), []
    for contacts in sequence:
        referee.update(contacts)
        reasons.append(referee.release_reason)
        if referee.released:
            referee.restore(referee.get_state()._replace(release_reason=-1, release_step=-1))
    return reasons


@pytest.mark.parametrize(("contacts", "kind"), [(GRASP, ReleaseReason.ACTIVE), (PUSH, ReleaseReason.PASSIVE)])
def test_release_after_exactly_a_hundred_steps(contacts: Contacts, kind: ReleaseReason) -> None:
    assert releases([contacts] * 100) == [None] * 99 + [kind]


@pytest.mark.parametrize("breaker", [NOTHING, ONE_FINGER])
@pytest.mark.parametrize("contacts", [GRASP, PUSH])
def test_an_interruption_starts_the_count_anew(contacts: Contacts, breaker: Contacts) -> None:
    assert releases([contacts] * 99 + [breaker] + [contacts] * 99) == [None] * 199


@pytest.mark.parametrize(
    "point", [(0.011, 0, 0.03), (-0.011, 0, 0.03), (0, 0.009, 0.03), (0, -0.009, 0.03), (0, 0, 0), (0, 0, 0.055)]
)
def test_the_region_is_open(point: tuple[float, float, float]) -> None:
    edge, center = np.array([point], dtype=np.float64), np.array([[0, 0, 0.03]])
    for share, kind in ((1.0, ReleaseReason.PASSIVE), (1.5, ReleaseReason.PASSIVE), (0.999, ReleaseReason.ACTIVE)):
        points = edge if share == 1.0 else center + share * (edge - center)
        assert releases([PUSH._replace(finger_points=(points, points))] * 100)[-1] is kind


@given(st.lists(st.sampled_from([GRASP, PUSH, ONE_FINGER, NOTHING]), max_size=300))
def test_release_means_an_unbroken_run(sequence: list[Contacts]) -> None:
    for end, kind in enumerate(releases(sequence)):
        wanted = {ReleaseReason.ACTIVE: GRASP, ReleaseReason.PASSIVE: PUSH}
        run = sequence[end - 99 : end + 1] if end >= 99 else []
        expected = next((k for k, c in wanted.items() if len(run) == 100 and all(x is c for x in run)), None)
        assert kind is expected


def statuses(sequence: list[Contacts], released: bool = True) -> list[EpisodeStatus]:
    referee = make_referee(released)
    return [referee.update(contacts) for contacts in sequence]


def make_referee(released: bool, steps: int = 0) -> Referee:
    """Return the referee of an episode that has run for some steps; unless `released`, no release is possible."""
    config = CONFIG if released else dataclasses.replace(CONFIG, release_steps=10**9)
    referee = Referee(config)
    state = referee.get_state()._replace(steps=steps)
    referee.restore(state._replace(release_reason=0, release_step=1) if released else state)
    return referee


def test_success_needs_a_hundred_steps_at_the_goal() -> None:
    assert statuses([AT_GOAL] * 100) == [EpisodeStatus.RUNNING] * 99 + [EpisodeStatus.SUCCESS]
    assert EpisodeStatus.SUCCESS not in statuses([AT_GOAL] * 99 + [GRASP] + [AT_GOAL] * 99)
    assert EpisodeStatus.SUCCESS not in statuses([AT_GOAL] * 200, released=False)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (3**-0.5, -(3**-0.5), 3**-0.5)])
def test_the_goal_is_an_open_ball(direction: tuple[float, ...]) -> None:
    for distance, status in ((0.1500001, EpisodeStatus.RUNNING), (0.1499, EpisodeStatus.SUCCESS)):
        position = tuple((np.array(CONFIG.goal_center) + distance * np.array(direction)).tolist())
        assert statuses([AT_GOAL._replace(gripper_position=position)] * 100)[-1] is status


def test_human_contact_counts_at_any_time() -> None:
    touch = Contacts(robot_touches_hand=True)
    assert statuses([touch], released=False) == [EpisodeStatus.HUMAN_CONTACT]
    assert statuses([touch], released=True) == [EpisodeStatus.HUMAN_CONTACT]


@pytest.mark.parametrize(
    ("contacts", "dropped"),
    [
        (Contacts(object_supported=True, object_height=1.0), True),
        (Contacts(object_height=0.919), True),
        (Contacts(object_height=CONFIG.drop_height), False),
        (ONE_FINGER._replace(object_supported=True, object_height=1.0), True),
        (GRASP._replace(object_supported=True, object_height=0.5), False),
    ],
)
def test_drop(contacts: Contacts, dropped: bool) -> None:
    assert statuses([contacts]) == [EpisodeStatus.OBJECT_DROP if dropped else EpisodeStatus.RUNNING]
    assert statuses([contacts], released=False) == [EpisodeStatus.RUNNING]


def test_failures_combine_and_exclude_success() -> None:
    both = Contacts(robot_touches_hand=True, object_height=0.5)
    assert statuses([both]) == [EpisodeStatus.HUMAN_CONTACT | EpisodeStatus.OBJECT_DROP]
    assert statuses([AT_GOAL] * 99 + [AT_GOAL._replace(robot_touches_hand=True)])[-1] is EpisodeStatus.HUMAN_CONTACT


def test_timeout_only_without_success() -> None:
    horizon = CONFIG.horizon_steps
    referee = make_referee(False, horizon - 2)
    assert referee.update(NOTHING) is EpisodeStatus.RUNNING
    assert referee.update(NOTHING) is EpisodeStatus.TIMEOUT
    contact = make_referee(False, horizon - 1).update(Contacts(robot_touches_hand=True))
    assert contact == EpisodeStatus.HUMAN_CONTACT | EpisodeStatus.TIMEOUT
    referee = make_referee(True, horizon - 100)
    for _ in range(99):
        referee.update(AT_GOAL)
    assert referee.update(AT_GOAL) is EpisodeStatus.SUCCESS


def test_bits_are_those_of_handoversim() -> None:
    bits = {status.name: status.value for status in EpisodeStatus}
    assert bits == {"SUCCESS": 1, "HUMAN_CONTACT": 2, "OBJECT_DROP": 4, "TIMEOUT": 8}
    assert EpisodeStatus.RUNNING == 0
    labels = {0: "running", 1: "success", 2: "contact", 4: "drop", 8: "timeout", 6: "contact+drop"}
    assert {bits: EpisodeStatus(bits).label for bits in labels} == labels


def test_referee_reports_the_release_step() -> None:
    referee = Referee(CONFIG)
    assert referee.get_state() == (0, 0, -1, -1, 0, 0, 0)
    for _ in range(10):
        referee.update(NOTHING)
    for _ in range(100):
        assert referee.release_step is None
        referee.update(GRASP)
    assert referee.release_step == 110
    assert referee.release_reason is ReleaseReason.ACTIVE
    referee.update(PUSH)
    assert referee.release_step == 110


def test_a_voluntary_release_takes_effect_once() -> None:
    referee = Referee(CONFIG)
    for step in range(5):
        assert (referee.released, referee.steps) == (False, step)
        referee.update(NOTHING)
    for _ in range(3):
        referee.release_voluntarily()
        assert (referee.release_reason, referee.release_step) == (ReleaseReason.VOLUNTARY, 5)
        assert referee.released
        referee.update(GRASP)


@pytest.mark.parametrize("kind", [GRASP, PUSH])
def test_other_numbers_of_steps(kind: Contacts) -> None:
    rules = dataclasses.replace(CONFIG, release_steps=300, success_steps=400, horizon_steps=1000)
    referee = Referee(rules)
    assert [bool(referee.update(kind)) or referee.released for _ in range(300)] == [False] * 299 + [True]
    assert (referee.release_step, referee.status) == (300, EpisodeStatus.RUNNING)
    assert [referee.update(AT_GOAL) for _ in range(400)] == [EpisodeStatus.RUNNING] * 399 + [EpisodeStatus.SUCCESS]
    idle = Referee(rules)
    assert [idle.update(NOTHING) for _ in range(1000)] == [EpisodeStatus.RUNNING] * 999 + [EpisodeStatus.TIMEOUT]


#: Rules with short periods, so that few steps lead to releases and ends, and with distances that need no rounding.
RULES = ProtocolConfig(
    release_steps=4, success_steps=3, horizon_steps=40, goal_center=(0.5, 0.0, 1.25), goal_radius=0.25
)
#: Positions inside and outside of the goal's ball, along its diagonal, and on its surface.
INNER, OUTER = (tuple(value + offset for value in RULES.goal_center) for offset in (0.144, -0.145))
SURFACE = (0.5, 0.0, 1.0)
OUTSIDE = np.array([[0.02, 0.0, 0.03]], dtype=np.float32)

POINTS = st.sampled_from([NO_POINTS, INSIDE, OUTSIDE, np.concatenate([OUTSIDE, INSIDE])])
STEP = st.builds(
    Contacts,
    robot_touches_hand=st.sampled_from([False] * 30 + [True]),
    robot_touches_object=st.sampled_from([True, True, False]),
    finger_points=st.tuples(POINTS, POINTS),
    object_supported=st.sampled_from([False] * 8 + [True]),
    object_height=st.sampled_from([1.2, 1.2, RULES.drop_height, 0.9]),
    gripper_position=st.sampled_from([RULES.goal_center, INNER, INNER, OUTER, SURFACE]),
)


def stack_contacts(steps: list[Contacts], config: ProtocolConfig) -> RolloutContacts:
    """Return the contacts of k steps of a single world as a batch (n = 1)."""
    rows = [
        (
            step.robot_touches_hand,
            step.robot_touches_object,
            [len(points) > 0 for points in step.finger_points],
            [bool(find_points_in_grasp_region(points, config).any()) for points in step.finger_points],
            step.object_supported,
            step.object_height,
            step.gripper_position,
        )
        for step in steps
    ]
    return RolloutContacts(*(np.array(column)[:, None] for column in zip(*rows, strict=True)))


@st.composite
def streams(draw: st.DrawFn) -> list[list[Contacts]]:
    """Draw the contacts of some episodes; steps are repeated so that conditions hold for several steps.

    In the first steps of all episodes, often nothing touches.
    """
    length, idle = draw(st.integers(1, 60)), draw(st.sampled_from([0, 0, 11, 50]))
    episodes = []
    for _ in range(draw(st.integers(1, 4))):
        steps = [Contacts()] * idle
        while len(steps) < length:
            steps += [consistent(draw(STEP))] * draw(st.integers(1, 9))
        episodes.append(steps[:length])
    return episodes


def consistent(step: Contacts) -> Contacts:
    """Remove finger points of steps in which the robot does not touch the object."""
    return step if step.robot_touches_object else step._replace(finger_points=(NO_POINTS, NO_POINTS))


def arrays(episodes: list[list[Contacts]]) -> RolloutContacts:
    """Return the same contacts as arrays (k, n)."""
    columns = zip(*(stack_contacts(steps, RULES) for steps in episodes), strict=True)
    return RolloutContacts(*(np.concatenate(column, axis=1) for column in columns))


def stack_states(states: list[RefereeState]) -> RefereeState:
    return RefereeState(*np.array(states).T.copy())


def step_by_step(referee: Referee, steps: list[Contacts]) -> tuple[int, RefereeState]:
    """Return the index of the step with the first release or end, or of the last step, and the state after it."""
    held = not referee.released
    for number, step in enumerate(steps):
        if referee.update(step) or (held and referee.released):
            return number, referee.get_state()
    return len(steps) - 1, referee.get_state()


def without_final_count(last: int, state: RefereeState) -> tuple[int, RefereeState]:
    """Clear the goal count of an episode that has ended, which no rule uses any more."""
    return last, state._replace(goal_steps=0) if state.status else state


@pytest.mark.parametrize(
    ("is_device", "chunk"),
    [(False, 1), (False, 2), (False, 5), (False, 60), pytest.param(True, 5, marks=pytest.mark.slow)],
)
@settings(max_examples=12)
@example([[GRASP] * 4 + [Contacts(object_supported=True)]], False)
@example([[Contacts()] * 45], False)
@given(streams(), st.booleans())
def test_arrays_give_the_states_of_the_referee(
    is_device: bool, chunk: int, episodes: list[list[Contacts]], releases_voluntarily: bool
) -> None:
    """On a device, episodes that have ended stay in the batch, with unchanged states."""
    referees = [Referee(RULES) for _ in episodes]
    restored = [Referee(RULES) for _ in episodes]
    if releases_voluntarily:
        referees[0].release_voluntarily()
        restored[0].release_voluntarily()
    start = [0] * len(episodes)
    while running := [
        number for number, steps in enumerate(episodes) if start[number] < len(steps) and not referees[number].status
    ]:
        length = min(chunk, *(len(episodes[number]) - start[number] for number in running))
        parts = [episodes[number][start[number] : start[number] + length] for number in running]
        ended = [number for number, referee in enumerate(referees) if is_device and referee.status]
        contacts = arrays(parts + [episodes[number][:length] for number in ended])
        before = stack_states([restored[number].get_state() for number in running + ended])
        with make_device_tensors() if is_device else contextlib.nullcontext(NUMPY_ARRAYS) as factory:
            states = RefereeState(*map(factory.asarray, before))
            rows = factory.arange(len(running + ended))
            end = make_judge(states, RULES)(rows, RolloutContacts(*map(factory.asarray, contacts)))
            states, end = RefereeState(*map(to_numpy, states)), RolloutEnd(*map(to_numpy, end))
        for place, number in enumerate(running):
            was_released = referees[number].released
            last, state = expected = step_by_step(referees[number], parts[place])
            assert without_final_count(last, states.select_rows(place)) == without_final_count(*expected)
            assert end.steps[place] == last + 1
            assert end.released[place] == (referees[number].released and not was_released)
            assert end.ended[place] == (state.status != 0)
            restored[number].restore(states.select_rows(place))
            for name in ("status", "release_reason", "release_step", "released"):
                assert getattr(restored[number], name) == getattr(referees[number], name), name
            start[number] += last + 1
        for place, number in enumerate(ended, len(running)):
            assert (end.steps[place], end.released[place], end.ended[place]) == (0, False, True)
            assert states.select_rows(place) == restored[number].get_state()
