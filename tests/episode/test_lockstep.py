"""Tests of the rules on arrays, which give the same states as the referee step by step."""

import contextlib

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from handover_marl.config import ProtocolConfig
from handover_marl.episode.referee import Referee, RefereeState, make_judge
from handover_marl.geometry.arrays import NUMPY_ARRAYS, to_numpy
from handover_marl.simulation.world import NO_POINTS, Contacts, RolloutContacts, RolloutEnd, find_points_in_grasp_region
from tests.helpers.tensors import make_device_tensors

#: Rules with short periods, so that few steps lead to releases and ends, and with distances that need no rounding.
RULES = ProtocolConfig(
    release_steps=4, success_steps=3, horizon_steps=40, goal_center=(0.5, 0.0, 1.25), goal_radius=0.25
)
#: Positions inside and outside of the goal's ball, along its diagonal, and on its surface.
INNER, OUTER = (tuple(value + offset for value in RULES.goal_center) for offset in (0.144, -0.145))
SURFACE = (0.5, 0.0, 1.0)
INSIDE = np.array([[0.0, 0.0, 0.03]], dtype=np.float32)
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
    [
        (False, 1),
        (False, 2),
        (False, 5),
        (False, 60),
        pytest.param(True, 5, marks=pytest.mark.slow),
    ],
)
@settings(max_examples=12)
@example(
    [[Contacts(robot_touches_object=True, finger_points=(INSIDE, INSIDE))] * 4 + [Contacts(object_supported=True)]],
    False,
)
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
            assert restored[number].status == referees[number].status
            assert restored[number].release_reason == referees[number].release_reason
            assert restored[number].release_step == referees[number].release_step
            assert restored[number].released == referees[number].released
            start[number] += last + 1
        for place, number in enumerate(ended, len(running)):
            assert (end.steps[place], end.released[place], end.ended[place]) == (0, False, True)
            assert states.select_rows(place) == restored[number].get_state()
