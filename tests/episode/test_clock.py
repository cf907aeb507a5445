"""Tests of the steps at which policies act, their hold times and their errors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from handover_marl.episode.loop import call_policy, start_policy, steps_from_hold_time
from handover_marl.errors import OptionError, PolicyError, SimulationError
from handover_marl.policies.batch import SequentialPolicyBatch

SEEN: dict[str, np.ndarray] = {}


class CountingPolicy:
    """Policy whose action is the number of its calls since the reset, held for `hold_time` (s)."""

    name = "counting"

    def __init__(self, hold_time: Any, error: BaseException | None = None) -> None:
        self.hold_time = hold_time
        self.asked = 0
        self.error = error
        self.prepared: tuple[str, ...] = ()

    def prepare(self, object_names: Sequence[str]) -> None:
        self.prepared += tuple(object_names)

    def reset(self, seed: int | None = None) -> None:
        if self.error is not None:
            raise self.error
        self.asked = 0

    def act(self, observation: dict[str, Any]) -> np.ndarray:
        if self.error is not None:
            raise self.error
        self.asked += 1
        return np.full(9, self.asked, dtype=np.float32)


@pytest.mark.parametrize(
    ("hold_time", "expected"),
    [
        (0.1, [1, 2, 3, 4, 5]),
        (0.25, [1, 1, 1, 2, 2]),
        (0.3, [1, 1, 1, 2, 2]),
        (0.001, [1, 2, 3, 4, 5]),
        (float("inf"), [1] * 5),
    ],
)
def test_policies_are_asked_when_they_want_to_be(hold_time: float, expected: list[int]) -> None:
    batch, row = SequentialPolicyBatch([CountingPolicy(hold_time)], np.asarray), np.array([0])
    for _ in range(2):
        batch.reset(0, None, ())
        found = [batch.act(row, lambda rows: SEEN, np.array([100 * n]))[0] for n in range(5)]
        assert [int(actions[0, 0]) for actions in found] == expected


@pytest.mark.parametrize("hold_time", [0, -0.1, float("nan"), "0.1", None, True])
def test_no_time_at_all_is_refused(hold_time: Any) -> None:
    with pytest.raises(OptionError, match="hold_time"):
        call_policy(CountingPolicy(hold_time), SEEN, 0)


def test_short_times_are_one_step() -> None:
    assert steps_from_hold_time(1e-9) == steps_from_hold_time(0.001) == 1
    assert steps_from_hold_time(np.float32(0.1)) == 100
    assert steps_from_hold_time(1e300) == steps_from_hold_time(np.inf) == steps_from_hold_time(1e9) == 10**12
    assert steps_from_hold_time(np.float32(1e30)) == 10**12
    assert steps_from_hold_time(999_999_999.0) == 10**12 - 1000
    assert steps_from_hold_time(0.0014) == 1
    assert steps_from_hold_time(0.0016) == 2


@pytest.mark.parametrize("error", [ZeroDivisionError("nought"), SystemExit("bye")])
def test_whose_fault_it_was(error: BaseException) -> None:
    policy = CountingPolicy(0.1, error)
    with pytest.raises(PolicyError, match=rf"policy 'counting' failed \(reset\): {type(error).__name__}: {error}"):
        start_policy(policy, None)
    with pytest.raises(PolicyError, match=r"policy 'counting' failed \(after 300 steps\)"):
        call_policy(policy, SEEN, 300)


def test_errors_of_the_library_and_of_the_user_stay_what_they_are() -> None:
    with pytest.raises(SimulationError, match="broken"):
        start_policy(CountingPolicy(0.1, SimulationError("broken")), None)
    with pytest.raises(KeyboardInterrupt):
        call_policy(CountingPolicy(0.1, KeyboardInterrupt()), SEEN, 0)
