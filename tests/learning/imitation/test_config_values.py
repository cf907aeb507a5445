"""Tests of the values of configurations, on which the names of files of plans and the reuse of views depend."""

from handover_marl.learning.imitation.config_values import list_values


def test_values_do_not_depend_on_names() -> None:
    before = {"seed": 3, "limits": {"near": 0.1, "far": (1, 2)}}
    after = {"start": 3, "bounds": {"low": 0.1, "high": (1, 2)}}
    assert list_values(before) == list_values(after) == [3, 0.1, (1, 2)]
