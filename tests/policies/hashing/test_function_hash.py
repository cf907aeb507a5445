"""Tests of hashes of functions and objects."""

import functools
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from handover_marl.policies.hashing.function_hash import hash_function, list_packages

WEIGHTS = np.arange(3.0)
OFFSET = 1.0


def use_weights(value: float) -> float:
    return float(WEIGHTS.sum()) * value


def use_nested(value: float) -> float:
    return max((lambda part: part + OFFSET)(item) for item in (value,))


def use_helper(value: float) -> float:
    return use_weights(value)


def make(gain: float, table: Any = None) -> Callable[[float], float]:
    def multiply(value: float, power: int = 2) -> float:
        return gain * value**power if table is None else float(table["weights"][0])

    return multiply


class Linear:
    bias = np.zeros(2)

    def __init__(self, slope: float) -> None:
        self.slope, self.unused = slope, None

    def __call__(self, value: float) -> float:
        return self.slope * value


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (lambda: make(1.0), lambda: make(2.0)),
        (lambda: lambda value: value + 1, lambda: lambda value: value + 2),
        (lambda: math.sin, lambda: math.cos),
        (lambda: Linear(1.0), lambda: Linear(2.0)),
        (lambda: Linear(1.0).__call__, lambda: Linear(2.0).__call__),
        (lambda: functools.partial(make(1.0), power=1), lambda: functools.partial(make(1.0), power=3)),
        (lambda: functools.partial(use_weights), lambda: functools.partial(use_helper)),
        (lambda: make(1.0, {"weights": np.zeros(2)}), lambda: make(1.0, {"weights": np.ones(2)})),
        (lambda: make(1.0, {"weights": np.zeros(2)}), lambda: make(1.0, {"weights": np.zeros(2, np.float32)})),
        (lambda: make(1.0, {"weights": [1]}), lambda: make(1.0, {"weights": [2]})),
    ],
)
def test_functions_differ(first: Callable[[], Any], second: Callable[[], Any]) -> None:
    assert hash_function(first()) == hash_function(first())
    assert hash_function(first()) != hash_function(second())


@pytest.mark.parametrize(
    ("name", "value"), [("WEIGHTS", np.arange(4.0)), ("OFFSET", 2.0), ("use_weights", lambda value: 3.0)]
)
@pytest.mark.parametrize("function", [use_weights, use_nested, use_helper, lambda value: use_helper(value)])
def test_variables_of_the_module_count_where_they_are_used(
    function: Any, name: str, value: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    uses = {
        "WEIGHTS": function is not use_nested,
        "OFFSET": function is use_nested,
        "use_weights": function not in (use_weights, use_nested),
    }
    before = hash_function(function)
    monkeypatch.setitem(globals(), name, value)
    assert (hash_function(function) != before) == uses[name]


def test_arrays_of_a_class_count(monkeypatch: pytest.MonkeyPatch) -> None:
    before = hash_function(Linear(1.0))
    monkeypatch.setattr(Linear, "bias", np.ones(2))
    assert hash_function(Linear(1.0)) != before


def test_objects_may_refer_to_each_other() -> None:
    first, second = SimpleNamespace(), SimpleNamespace()
    first.other, second.other = second, first
    function = Linear(1.0)
    function.unused = first  # type: ignore[assignment]
    assert hash_function(function) == hash_function(function)


def test_packages_of_imported_functions() -> None:
    assert list_packages(use_weights) == ("tests",)
    assert list_packages(Linear(1.0)) == list_packages(Linear(1.0).__call__) == ("tests",)
    assert list_packages(functools.partial(use_weights)) == ("tests",)
    assert list_packages(lambda value: value) == ()
    assert list_packages(np.linalg.norm) == list_packages(math.sin) == ()
