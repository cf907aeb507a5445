"""Tests of the terms of `TermWeights`: their formulas, with constructed transitions, and their weights."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.envs.reward_terms import TERMS, TermRewardSource, TermWeights, compute_hand_distance
from handover_marl.envs.transition import Transition
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.simulation.contacts import Contacts

points = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def state(gripper: Any = (0.0, 0.0, 0.0), wrist: Any = (0.0, 0.0, 1.0), hand: bool = True) -> dict[str, Any]:
    return {
        "gripper_pose": np.array([*gripper, 0, 0, 0, 1], dtype=np.float32),
        "hand_keypoints": np.tile(np.float32(wrist), (16, 1)),
        "hand_present": np.float32([hand]),
    }


def transition(before: Any = None, after: Any = None, **changes: Any) -> Transition:
    before, after = before or state(), after or state()
    fields: dict[str, Any] = {
        "observations": {"giver": before, "receiver": before},
        "next_observations": {"giver": after, "receiver": after},
        "actions": {},
        "infos": {},
        "contacts": Contacts(),
        "status": EpisodeStatus.RUNNING,
        "duration": 0.1,
        "step": 0,
        "terminated": False,
        "truncated": False,
    }
    return Transition(**fields | changes)


def value(name: str, **changes: Any) -> float:
    return TERMS[name].compute([transition(**changes)])


def test_success_and_time() -> None:
    assert value("success") == value("success", status=EpisodeStatus.TIMEOUT) == 0.0
    assert value("success", status=EpisodeStatus.SUCCESS) == 1.0
    assert value("time", duration=0.037) == 0.037


@given(points, points)
def test_paths_are_distances(first: Any, second: Any) -> None:
    distance = float(np.linalg.norm(np.float32(first) - np.float32(second)))
    assert value("gripper_path", before=state(first), after=state(second)) == pytest.approx(distance, abs=1e-6)
    wrists = state(wrist=first), state(wrist=second)
    assert value("hand_path", before=wrists[0], after=wrists[1]) == pytest.approx(distance, abs=1e-6)


def test_hands_that_are_absent_have_no_terms() -> None:
    for name in ("hand_path", "hand_jerk", "clearance"):
        for before, after in ((True, False), (False, True), (False, False)):
            states = state(wrist=(0, 0, 0.1), hand=before), state(wrist=(0, 0, 0.9), hand=after)
            assert TERMS[name].compute([transition(*states)] * (1 if name != "hand_jerk" else 3)) == 0.0


@pytest.mark.parametrize(("name", "body"), [("gripper_jerk", "gripper"), ("hand_jerk", "wrist")])
def test_jerk_of_a_cubic_motion_is_constant(name: str, body: str) -> None:
    """The motion x = t^3 has a jerk of 6 m/s^3, which integrates to 0.6 m/s^2 in a step of 0.1 s."""
    source = TermRewardSource(TermWeights(receiver={name: 1.0}))
    states = [state(**{body: (0.0, (0.1 * number) ** 3, 0.0)}) for number in range(8)]
    for _ in range(2):
        source.start(transition(after=states[0]))
        values = [source.compute(transition(*pair))["receiver"][name] for pair in itertools.pairwise(states)]
        assert values[:2] == [0.0, 0.0]
        np.testing.assert_allclose(values[2:], 0.6, rtol=1e-3)
    shorter = source.compute(transition(states[-2], states[-1], duration=0.03))
    assert shorter["receiver"][name] == 0.0, "a shorter last step"


def test_forces_are_integrated() -> None:
    contacts = Contacts(robot_object_force=20.0, robot_hand_force=3.0)
    assert value("object_force", contacts=contacts) == pytest.approx(2.0)
    assert value("hand_force", contacts=contacts, duration=0.2) == pytest.approx(0.6)


def test_clearance_is_measured_from_the_gripper() -> None:
    """Distances are measured from boxes that reach z = 0.1126 m (fingers) and y = 0.104 m (body) of the hand link."""
    assert compute_hand_distance(state(wrist=(0.0, 0.0533, 0.2))) == pytest.approx(0.2 - 0.1126, abs=1e-4)
    assert compute_hand_distance(state(wrist=(0.0, 0.154, 0.02))) == pytest.approx(0.05, abs=1e-4)
    assert compute_hand_distance(state(wrist=(0.0, 0.0, 0.02))) == 0.0
    assert value("clearance", after=state(wrist=(0.0, 0.154, 0.02))) == pytest.approx(-0.05 * 0.1, abs=1e-5)
    assert value("clearance", after=state(wrist=(0.0, 0.5, 0.02))) == 0.0
    turned = state(wrist=(0.154, 0.0, 0.02))
    turned["gripper_pose"][3:] = [0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)]  # the gripper's y axis is the world's x axis
    assert compute_hand_distance(turned) == pytest.approx(0.05, abs=1e-4)


def test_weights_multiply_terms() -> None:
    terms = TermRewardSource(TermWeights(receiver={"time": -2.0, "success": 5.0}, giver={"time": 3.0}))
    assert terms.start(transition()) == {"giver": {"time": 0.0}, "receiver": {"time": 0.0, "success": 0.0}}
    found = terms.compute(transition(status=EpisodeStatus.SUCCESS))
    assert found == {"giver": {"time": pytest.approx(0.3)}, "receiver": {"time": pytest.approx(-0.2), "success": 5.0}}


def test_wrong_weights_are_named() -> None:
    with pytest.raises(UnknownNameError, match="reward term 'speed'; valid: success, gripper_path"):
        TermWeights(receiver={"speed": 1.0})
    for wrong in (float("nan"), "1", None, True):
        with pytest.raises(OptionError, match="weight of term 'time' of the giver must be a finite number"):
            TermWeights(giver={"time": wrong})  # type: ignore[dict-item]
    with pytest.raises(OptionError, match="receiver of TermWeights must be a dict"):
        TermWeights(receiver=3.0)  # type: ignore[arg-type]


def test_every_term_has_a_unit_and_a_row_in_the_table() -> None:
    import handover_marl.envs.reward_terms as module

    rows = [line.split("|") for line in (module.__doc__ or "").splitlines() if line.startswith("| ")][1:]
    documented = {row[1].strip(): row[3].strip() for row in rows}
    assert documented == {name: term.unit for name, term in TERMS.items()}
