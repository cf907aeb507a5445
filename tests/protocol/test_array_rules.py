"""Rules as arrays say of many steps of many episodes what the referee says step by step."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.array_rules import ContactArrays, Verdicts, judge
from handover_marl.protocol.contacts import NO_POINTS, Contacts
from handover_marl.protocol.referee import Referee, Standing
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus
from tests.training.scripts import script

#: Short, so that few steps make things happen.
RULES = ProtocolConfig(release_steps=4, success_steps=3, horizon_steps=40)
INSIDE = np.array([[0.0, 0.0, 0.03]], dtype=np.float32)
OUTSIDE = np.array([[0.02, 0.0, 0.03]], dtype=np.float32)

POINTS = st.sampled_from([NO_POINTS, INSIDE, OUTSIDE, np.concatenate([OUTSIDE, INSIDE])])
STEP = st.builds(
    Contacts,
    robot_hand=st.sampled_from([False] * 30 + [True]),
    robot_object=st.sampled_from([True, True, True, False]),
    finger_points=st.tuples(POINTS, POINTS),
    object_supported=st.sampled_from([False] * 8 + [True]),
    object_height=st.sampled_from([1.2, 1.2, 1.2, 0.9]),
    gripper_position=st.sampled_from([RULES.goal_center, RULES.goal_center, (0.0, 0.0, 0.0)]),
)


@st.composite
def streams(draw: st.DrawFn) -> list[list[Contacts]]:
    """Contacts of some episodes, each step repeated now and then so that something holds for long."""
    length = draw(st.integers(1, 60))
    episodes = []
    for _ in range(draw(st.integers(1, 4))):
        steps: list[Contacts] = []
        while len(steps) < length:
            steps += [consistent(draw(STEP))] * draw(st.integers(1, 9))
        episodes.append(steps[:length])
    return episodes


def consistent(step: Contacts) -> Contacts:
    """Fingers are parts of the robot."""
    return step if step.robot_object else step._replace(finger_points=(NO_POINTS, NO_POINTS))


def arrays(episodes: list[list[Contacts]]) -> ContactArrays:
    """The same contacts, (k, n)."""
    columns = zip(*(ContactArrays.of(steps, RULES) for steps in episodes), strict=True)
    return ContactArrays(*(np.concatenate(column, axis=1) for column in columns))


def step_by_step(referee: Referee, steps: list[Contacts]) -> tuple[int, Standing]:
    """Until something happens: the last step that counts, and how things stand."""
    held = not referee.released
    for number, step in enumerate(steps):
        if referee.update(step) or (held and referee.released):
            return number, referee.standing()
    return len(steps) - 1, referee.standing()


def telling(last: int, standing: Standing) -> tuple[int, Standing]:
    """Without a count that is of no use any more once an episode has ended."""
    return last, standing._replace(goal_steps=0) if standing.status else standing


@settings(max_examples=100, deadline=None)
@given(streams(), st.integers(1, 60), st.booleans())
def test_arrays_judge_as_the_referee_does(episodes: list[list[Contacts]], chunk: int, given_away: bool) -> None:
    referees = [Referee(RULES) for _ in episodes]
    resumed = [Referee(RULES) for _ in episodes]
    if given_away:
        referees[0].give()
        resumed[0].give()
    begun = [0] * len(episodes)
    while running := [
        number for number, steps in enumerate(episodes) if begun[number] < len(steps) and not referees[number].status
    ]:
        length = min(chunk, *(len(episodes[number]) - begun[number] for number in running))
        parts = [episodes[number][begun[number] : begun[number] + length] for number in running]
        before = Verdicts.of([resumed[number].standing() for number in running])
        last, verdicts = judge(before, arrays(parts), RULES)
        for place, number in enumerate(running):
            expected = step_by_step(referees[number], parts[place])
            found = last[place], verdicts.standing(place)
            assert telling(*found) == telling(*expected)
            resumed[number].resume(verdicts.standing(place))
            assert resumed[number].status == referees[number].status
            assert resumed[number].release == referees[number].release
            assert resumed[number].release_step == referees[number].release_step
            assert resumed[number].released == referees[number].released
            begun[number] += int(last[place]) + 1


@pytest.mark.parametrize("status", [EpisodeStatus.SUCCESS, EpisodeStatus.TIMEOUT])
def test_whole_episodes_come_to_their_ends(status: EpisodeStatus) -> None:
    holds = Contacts(
        robot_object=True, finger_points=(INSIDE, INSIDE), object_height=1.2, gripper_position=RULES.goal_center
    )
    steps = [holds if status is EpisodeStatus.SUCCESS else Contacts()] * 50
    referee = Referee(RULES)
    last, verdicts = judge(Verdicts.of([referee.standing()]), arrays([steps]), RULES)
    if status is EpisodeStatus.SUCCESS:
        assert (last[0], verdicts.release[0], verdicts.status[0]) == (3, tuple(Release).index(Release.ACTIVE), 0)
        last, verdicts = judge(verdicts, arrays([steps[4:]]), RULES)
        # The step of letting go counts for the goal as well.
        assert verdicts.steps[0] == 4 + RULES.success_steps - 1
    assert EpisodeStatus(int(verdicts.status[0])) == status


def test_the_script_compares_whole_episodes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    check = script("check_array_rules", monkeypatch)
    args = check.Args(dataset="synthetic", episodes=3, together=2, receiver="yang2021", workers=1)
    check.main(args)
    assert "synthetic, s0 train, 3 episodes (3 replay)" in (told := capsys.readouterr().out)
    assert " times, 0 differences" in told

    def late(before: Verdicts, seen: ContactArrays, rules: ProtocolConfig) -> object:
        """Rules that let go a step too late."""
        return judge(before, seen, dataclasses.replace(rules, release_steps=rules.release_steps + 1))

    monkeypatch.setattr(check, "judge", late)
    with pytest.raises(SystemExit):
        check.main(dataclasses.replace(args, episodes=1, stretches=(50,)))
    assert "not Standing(" in capsys.readouterr().out
