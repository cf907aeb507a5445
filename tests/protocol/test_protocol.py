import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.contacts import NO_POINTS, Contacts
from handover_marl.protocol.referee import Referee
from handover_marl.protocol.release import Release, ReleaseRule
from handover_marl.protocol.status import EpisodeStatus, StatusRule

CONFIG = ProtocolConfig()
INSIDE = np.array([[0.0, 0.0, 0.03]], dtype=np.float32)
OUTSIDE = np.array([[0.02, 0.0, 0.03]], dtype=np.float32)

GRASP = Contacts(robot_object=True, finger_points=(INSIDE, INSIDE))
PUSH = Contacts(robot_object=True)
ONE_FINGER = Contacts(robot_object=True, finger_points=(INSIDE, NO_POINTS))
NOTHING = Contacts()
AT_GOAL = GRASP._replace(gripper_position=CONFIG.goal_center, object_height=1.25)


def releases(sequence: list[Contacts]) -> list[Release | None]:
    rule = ReleaseRule(CONFIG)
    return [rule.update(contacts) for contacts in sequence]


@pytest.mark.parametrize(("contacts", "kind"), [(GRASP, Release.ACTIVE), (PUSH, Release.PASSIVE)])
def test_release_after_exactly_a_hundred_steps(contacts: Contacts, kind: Release) -> None:
    assert releases([contacts] * 100) == [None] * 99 + [kind]


@pytest.mark.parametrize("breaker", [NOTHING, ONE_FINGER])
@pytest.mark.parametrize("contacts", [GRASP, PUSH])
def test_an_interruption_starts_the_count_anew(contacts: Contacts, breaker: Contacts) -> None:
    assert releases([contacts] * 99 + [breaker] + [contacts] * 99) == [None] * 199


def test_one_finger_never_releases() -> None:
    assert releases([ONE_FINGER] * 500) == [None] * 500


def test_fingers_outside_the_region_push() -> None:
    outside = Contacts(robot_object=True, finger_points=(OUTSIDE, OUTSIDE))
    assert releases([outside] * 100)[-1] is Release.PASSIVE


@pytest.mark.parametrize(
    "point", [(0.011, 0, 0.03), (-0.011, 0, 0.03), (0, 0.009, 0.03), (0, -0.009, 0.03), (0, 0, 0), (0, 0, 0.055)]
)
def test_the_region_is_open(point: tuple[float, float, float]) -> None:
    edge = np.array([point], dtype=np.float64)
    contacts = Contacts(robot_object=True, finger_points=(edge, edge))
    assert releases([contacts] * 100)[-1] is Release.PASSIVE
    nudged = edge * 0.999 + np.array([[0, 0, 0.03]]) * 0.001
    contacts = Contacts(robot_object=True, finger_points=(nudged, nudged))
    assert releases([contacts] * 100)[-1] is Release.ACTIVE


@given(st.lists(st.sampled_from([GRASP, PUSH, ONE_FINGER, NOTHING]), max_size=300))
def test_release_means_an_unbroken_run(sequence: list[Contacts]) -> None:
    for end, kind in enumerate(releases(sequence)):
        wanted = {Release.ACTIVE: GRASP, Release.PASSIVE: PUSH}
        run = sequence[end - 99 : end + 1] if end >= 99 else []
        expected = next((k for k, c in wanted.items() if len(run) == 100 and all(x is c for x in run)), None)
        assert kind is expected


def statuses(sequence: list[Contacts], released: bool = True) -> list[EpisodeStatus]:
    rule = StatusRule(CONFIG)
    return [rule.update(contacts, released, step + 1) for step, contacts in enumerate(sequence)]


def test_success_needs_a_hundred_steps_at_the_goal() -> None:
    assert statuses([AT_GOAL] * 100) == [EpisodeStatus.RUNNING] * 99 + [EpisodeStatus.SUCCESS]
    assert EpisodeStatus.SUCCESS not in statuses([AT_GOAL] * 99 + [GRASP] + [AT_GOAL] * 99)
    assert EpisodeStatus.SUCCESS not in statuses([AT_GOAL] * 200, released=False)


def test_the_goal_is_an_open_ball() -> None:
    x, y, z = CONFIG.goal_center
    on_edge = AT_GOAL._replace(gripper_position=(x + 0.1500001, y, z))
    within = AT_GOAL._replace(gripper_position=(x + 0.1499, y, z))
    assert statuses([on_edge] * 100)[-1] is EpisodeStatus.RUNNING
    assert statuses([within] * 100)[-1] is EpisodeStatus.SUCCESS


def test_human_contact_counts_at_any_time() -> None:
    touch = Contacts(robot_hand=True)
    assert statuses([touch], released=False) == [EpisodeStatus.HUMAN_CONTACT]
    assert statuses([touch], released=True) == [EpisodeStatus.HUMAN_CONTACT]


@pytest.mark.parametrize(
    ("contacts", "dropped"),
    [
        (Contacts(object_supported=True, object_height=1.0), True),
        (Contacts(object_height=0.919), True),
        (Contacts(object_height=0.93), False),
        (ONE_FINGER._replace(object_supported=True, object_height=1.0), True),
        (GRASP._replace(object_supported=True, object_height=0.5), False),
    ],
)
def test_drop(contacts: Contacts, dropped: bool) -> None:
    assert statuses([contacts]) == [EpisodeStatus.OBJECT_DROP if dropped else EpisodeStatus.RUNNING]
    assert statuses([contacts], released=False) == [EpisodeStatus.RUNNING]


def test_failures_combine_and_exclude_success() -> None:
    both = Contacts(robot_hand=True, object_height=0.5)
    assert statuses([both]) == [EpisodeStatus.HUMAN_CONTACT | EpisodeStatus.OBJECT_DROP]
    rule = StatusRule(CONFIG)
    for step in range(99):
        rule.update(AT_GOAL, True, step + 1)
    assert rule.update(AT_GOAL._replace(robot_hand=True), True, 100) is EpisodeStatus.HUMAN_CONTACT


def test_timeout_only_without_success() -> None:
    horizon = CONFIG.horizon_steps
    rule = StatusRule(CONFIG)
    assert rule.update(NOTHING, False, horizon - 1) is EpisodeStatus.RUNNING
    assert rule.update(NOTHING, False, horizon) is EpisodeStatus.TIMEOUT
    assert (
        StatusRule(CONFIG).update(Contacts(robot_hand=True), False, horizon)
        == EpisodeStatus.HUMAN_CONTACT | EpisodeStatus.TIMEOUT
    )
    rule = StatusRule(CONFIG)
    for step in range(99):
        rule.update(AT_GOAL, True, horizon - 99 + step)
    assert rule.update(AT_GOAL, True, horizon) is EpisodeStatus.SUCCESS


def test_labels() -> None:
    assert EpisodeStatus(0).label == "running"
    assert EpisodeStatus(6).label == "contact+drop"


def test_referee_tells_the_release_step() -> None:
    referee = Referee(CONFIG)
    for _ in range(10):
        referee.update(NOTHING)
    for _ in range(100):
        assert referee.release_step is None
        referee.update(GRASP)
    assert referee.release_step == 110
    assert referee.release is Release.ACTIVE
    referee.update(PUSH)
    assert referee.release_step == 110
