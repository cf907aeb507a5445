"""Tests of reward terms: their formulas, with constructed states, and their weights."""

import itertools
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.envs.rewards import SHAPED, SPARSE, TERMS, RewardWeights, StepData, WeightedRewardSource
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ONLY_ROW, ArrayFactory, is_tensor, to_numpy
from tests.helpers.tensors import make_device_tensors
from tests.learning.array_encodings import COUNT, draw_observation

RUNNING, SUCCESS = EpisodeStatus.RUNNING, EpisodeStatus.SUCCESS
GOAL = OFFICIAL_CONFIG.protocol.goal_center
SHAPING = ("distance", "grasp", "goal")
State = dict[str, np.ndarray]
points = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def situation(
    time: float = 0.0,
    gripper: tuple[float, ...] = (0.0, 0.0, 1.0),
    object_position: tuple[float, ...] = (0.3, 0.0, 1.0),
    grasped: bool = False,
    deviation: tuple[float, ...] = (0.0,) * 6,
    offered: bool = False,
    wrist: tuple[float, ...] | None = (0.0, 0.0, 2.0),
    forces: tuple[float, float] = (0.0, 0.0),
    turn: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0),
) -> State:
    """Return the state of one episode that the rewards depend on."""
    return {
        "time": np.array([[time]]),
        "gripper_pose": np.array([[*gripper, *turn]]),
        "object_poses": np.array([[[*object_position, 0.0, 0.0, 0.0, 1.0]]]),
        "deviation": np.array([[0.0, *deviation]]),
        "holding": np.array([[float(offered)]]),
        "released": np.array([[0.0]]),
        "hand_present": np.array([[float(wrist is not None)]]),
        "hand_keypoints": np.tile(np.float32(wrist or (0.0, 0.0, 0.0)), (1, 16, 1)),
        "grasped": np.array([grasped]),
        "robot_object_force": np.array([forces[0]]),
        "robot_hand_force": np.array([forces[1]]),
    }


situations = st.builds(
    situation,
    gripper=points,
    object_position=points,
    grasped=st.booleans(),
    deviation=st.tuples(*[st.floats(-0.3, 0.3)] * 6),
    offered=st.booleans(),
)


class Rewards:
    """Weighted terms of one episode, as numbers; times of states count in steps of 0.1 s unless they are given."""

    def __init__(self, weights: RewardWeights, start: State, goal: tuple[float, ...] = GOAL) -> None:
        self._source, self._steps = WeightedRewardSource(weights, goal, 1, NUMPY_ARRAYS), 0
        self._source.start(ONLY_ROW, StepData(np.zeros(1, dtype=int), lambda _: start, list))

    def compute(self, now: State, status: EpisodeStatus = RUNNING, duration: float = 0.1) -> dict[str, Any]:
        self._steps += 1
        if now:
            now = {**now, "time": np.array([[0.1 * (self._steps - 1) + duration]])}
        found = self._source.compute(ONLY_ROW, StepData(np.array([int(status)]), lambda _: now, list))
        return {agent: {name: float(value[0]) for name, value in own.items()} for agent, own in found.items()}


def terms(weights: RewardWeights, before: State, now: State, status: EpisodeStatus = RUNNING) -> dict[str, Any]:
    return Rewards(weights, before).compute(now, status)


def value(name: str, before: State, now: State, duration: float = 0.1) -> float:
    return float(Rewards(RewardWeights({name: 1.0}), before).compute(now, duration=duration)["receiver"][name])


def test_sparse_is_success_alone() -> None:
    later = situation(gripper=(0.2, 0.0, 1.0), grasped=True, deviation=(0.1,) * 6, offered=True)
    for status in EpisodeStatus:
        for found in terms(SPARSE, situation(), later, status).values():
            assert found == {"success": float(status is SUCCESS)}
    assert Rewards(SPARSE, {}).compute({}, SUCCESS) == {"receiver": {"success": 1.0}, "giver": {"success": 1.0}}
    outcomes = RewardWeights({"success": 2.0, "drop": -1.0}, {"contact": -3.0})
    assert terms(outcomes, {}, {}, EpisodeStatus.OBJECT_DROP)["receiver"] == {"success": 0.0, "drop": -1.0}
    assert terms(outcomes, {}, {}, EpisodeStatus.HUMAN_CONTACT)["giver"] == {"contact": -3.0}


@pytest.mark.slow
@given(st.lists(situations, min_size=2, max_size=8), st.sampled_from([SUCCESS, EpisodeStatus.HUMAN_CONTACT]))
def test_discounted_shaping_depends_only_on_the_first_state(path: list[State], end: EpisodeStatus) -> None:
    shaped = Rewards(SHAPED, path[0])
    total = 0.0
    for number, now in enumerate(path[1:]):
        last = number == len(path) - 2
        values = shaped.compute(now, end if last else RUNNING)["receiver"]
        total += SHAPED.gamma**number * sum(values[name] for name in SHAPING)
    # All potentials are 0 once the episode has ended.
    at_once = Rewards(SHAPED, path[0]).compute(path[0], end)["receiver"]
    assert total == pytest.approx(sum(at_once[name] for name in SHAPING), abs=1e-9)
    weights, grasped = SHAPED.receiver, bool(path[0]["grasped"][0])
    if grasped:
        expected = weights["distance"] + weights["grasp"]
        expected += weights["goal"] * (1.0 - np.linalg.norm(path[0]["gripper_pose"][0, :3] - GOAL))
        assert total == pytest.approx(-expected, abs=1e-9)


def test_a_truncated_episode_keeps_its_potential() -> None:
    near = situation(gripper=(0.29, 0.0, 1.0))
    assert terms(SHAPED, situation(), near, EpisodeStatus.TIMEOUT) == terms(SHAPED, situation(), near)


def test_approaching_grasping_and_carrying_are_rewarded() -> None:
    start = situation(gripper=(0.0, 0.0, 0.9))
    near = terms(SHAPED, start, situation(gripper=(0.2, 0.0, 0.8966)))["receiver"]["distance"]
    # The fingertips are 0.1034 m in front of the hand link: 0.1 m from the object, before them at its height, 0.3 m.
    before = 1.0 - np.hypot(0.3, 1.0 - 0.9 - 0.1034)
    assert near == pytest.approx(0.5 * (SHAPED.gamma * 0.9 - before), abs=1e-6)
    grasped = terms(SHAPED, situation(), situation(grasped=True))["receiver"]
    assert grasped["grasp"] > 0
    assert grasped["goal"] > 0


def test_costs_of_the_giver() -> None:
    later = situation(deviation=(0.05, 0, 0, 0.3, 0, 0))
    values, weights = terms(SHAPED, situation(offered=True), later)["giver"], SHAPED.giver
    assert values["effort"] == pytest.approx(weights["effort"] * 0.05**2 / 0.1)
    assert values["discomfort"] == pytest.approx(weights["discomfort"] * 0.15 * 0.1)
    assert values["waiting"] == pytest.approx(weights["waiting"] * 0.1)


def test_paths_are_distances() -> None:
    first, second = (0.1, -0.4, 0.8), (-0.3, 0.2, 1.0)
    distance = float(np.linalg.norm(np.subtract(first, second)))
    assert value("gripper_path", situation(gripper=first), situation(gripper=second)) == pytest.approx(distance)
    found = value("giver_path", situation(wrist=first), situation(wrist=second))
    assert found == pytest.approx(distance, abs=1e-6)


def test_hands_that_are_absent_have_no_terms() -> None:
    hands = (0.0, 0.0, 1.1), None
    for path in itertools.product(hands, repeat=5):
        if None in path[-2:]:
            found = Rewards(RewardWeights(dict.fromkeys(("giver_path", "giver_jerk"), 1.0)), situation(wrist=path[0]))
            assert not any([found.compute(situation(wrist=wrist)) for wrist in path[1:]][-1]["receiver"].values())
    assert value("clearance", situation(), situation(wrist=None)) == 0.0


@pytest.mark.parametrize(("name", "body"), [("gripper_jerk", "gripper"), ("giver_jerk", "wrist")])
def test_jerk_of_a_cubic_motion_is_constant(name: str, body: str) -> None:
    """The motion x = t^3 has a jerk of 6 m/s^3, which integrates to 0.6 m/s^2 in a step of 0.1 s."""
    states = [situation(**{body: (0.0, (0.1 * number) ** 3, 0.0)}) for number in range(8)]  # type: ignore[arg-type]
    cubic = Rewards(RewardWeights({name: 1.0}), states[0])
    values = [cubic.compute(state)["receiver"][name] for state in states[1:-1]]
    assert values[:2] == [0.0, 0.0]
    np.testing.assert_allclose(values[2:], 0.6, rtol=1e-3)
    assert cubic.compute(states[-1], duration=0.03)["receiver"][name] == 0.0, "a shorter last step"


def test_time_and_forces_are_integrated() -> None:
    pressed = situation(forces=(20.0, 3.0))
    assert value("time", situation(), situation(), 0.037) == pytest.approx(0.037, abs=1e-12)
    assert value("robot_object_force", situation(), pressed) == pytest.approx(2.0)
    assert value("robot_hand_force", situation(), pressed, 0.2) == pytest.approx(0.6)


def test_clearance_is_measured_from_the_gripper() -> None:
    """Distances are measured from boxes that reach z = 0.1126 m (fingers) and y = 0.104 m (body) of the hand link."""
    cases = [((0.0, 0.0533, 1.15), 0.15 - 0.1126), ((0.0, 0.154, 1.02), 0.05), ((0.0, 0.0, 1.02), 0.0)]
    for wrist, distance in cases:
        found = value("clearance", situation(), situation(wrist=wrist))
        assert found == pytest.approx((distance - 0.1) * 0.1, abs=1e-5)
    assert value("clearance", situation(), situation(wrist=(0.0, 0.5, 1.02))) == 0.0
    # The gripper's y axis is the world's x axis.
    turned = situation(wrist=(0.154, 0.0, 1.02), turn=(0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)))
    assert value("clearance", situation(), turned) == pytest.approx(-0.05 * 0.1, abs=1e-5)


def draw_step_data(seed: int, arrays: ArrayFactory) -> StepData:
    """Draw a step of many episodes: near the object and the goal, with and without hands and contacts."""
    rng, state = np.random.default_rng(seed), draw_observation(seed)
    state["time"][:] = 0.1 * seed
    state["hand_keypoints"] = state["gripper_pose"][:, None, :3] + rng.normal(0.0, 0.1, (COUNT, 16, 3))
    state |= {name: rng.random(COUNT) for name in ("robot_object_force", "robot_hand_force")}
    state["grasped"] = rng.random(COUNT) < 0.5
    status = rng.choice([0, 0, 0, 1, 2, 4, 6, 8, 10], COUNT)
    return StepData(
        arrays.asarray(status), lambda _: {key: arrays.asarray(values) for key, values in state.items()}, list
    )


def test_terms_of_tensors_equal_those_of_arrays() -> None:
    weights = RewardWeights(dict.fromkeys(TERMS, 1.0))
    with make_device_tensors() as tensors:
        results: list[dict[str, list[np.ndarray]]] = []
        for arrays in (NUMPY_ARRAYS, tensors):
            source, found = WeightedRewardSource(weights, GOAL, COUNT, arrays), defaultdict(list)
            source.start(arrays.arange(COUNT), draw_step_data(0, arrays))
            for step in range(1, 6):
                rows = arrays.asarray(np.random.default_rng(step).permutation(COUNT)[: COUNT - step])
                data = draw_step_data(step, arrays)
                chosen = StepData(
                    data.status[rows],
                    lambda _, data=data, rows=rows: {key: own[rows] for key, own in data.read_state(True).items()},
                    list,
                )
                for name, values in source.compute(rows, chosen)["receiver"].items():
                    assert is_tensor(values) == (arrays is tensors)
                    found[name].append(to_numpy(values))
            results.append(found)
    for name in TERMS:
        own, other = (np.concatenate(found[name]) for found in results)
        assert np.ptp(own) > 0.0, name
        np.testing.assert_allclose(other, own, rtol=0, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("weights", "error", "message"),
    [
        ({"receiver": {"speed": 1.0}}, UnknownNameError, "reward term 'speed'; valid: success, contact"),
        ({"giver": {"time": float("nan")}}, OptionError, "weight of term 'time' of the giver must be a finite number"),
        ({"giver": {"time": True}}, OptionError, "weight of term 'time' of the giver must be a finite number"),
        ({"receiver": 3.0}, OptionError, "receiver of RewardWeights must be a dict"),
        ({"gamma": 1.5}, OptionError, "gamma of RewardWeights must be a finite number from 0 to 1"),
    ],
)
def test_wrong_weights_are_named(weights: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        RewardWeights(**weights)
    chosen = RewardWeights(given := {"time": 1.0})
    given["time"] = 2.0
    assert chosen.receiver == {"time": 1.0}
