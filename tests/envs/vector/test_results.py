"""Tests of results as arrays: joining and dividing tensors on a device equals joining and dividing NumPy arrays."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from handover_marl.envs.vector.batch import EnvResult, merge_results, replace_rows, select_rows
from handover_marl.geometry.arrays import make_tensor_factory
from tests.envs.vector.comparison import assert_same, move_to_device
from tests.fake_device import FakeDevice

RNG = np.random.default_rng(0)
ROWS = np.array([4, 1])


@pytest.fixture(autouse=True)
def device() -> Iterator[None]:
    with FakeDevice():
        yield


def make_result(count: int, narrow: bool = False) -> EnvResult:
    """Return a random result of an agent with dictionaries and one with arrays; reward terms may be float32."""
    pose, features = (RNG.normal(size=(count, size)).astype(np.float32) for size in (7, 12))
    flags = [RNG.random(count) < 0.5 for _ in range(4)]
    terms = {"steps": RNG.integers(9, size=count), "term": RNG.normal(size=count).astype("f4" if narrow else "f8")}
    return EnvResult(
        {"giver": {"pose": pose, "pair": (pose[:, :3], pose[:, 3:])}, "receiver": features},
        {"giver": RNG.normal(size=count), "receiver": RNG.normal(size=count)},
        {"giver": flags[0], "receiver": flags[1]},
        {"giver": flags[2], "receiver": flags[3]},
        {"giver": terms, "receiver": dict(terms)},
    )


def assert_equal_on_device(function: Callable[..., Any], *results: Any) -> Any:
    """Compare a function of results on the device and as NumPy arrays, and return its value as NumPy arrays."""
    arrays = make_tensor_factory("cuda")
    expected = function(*results)
    assert_same(function(*(move_to_device(result, arrays) for result in results)), expected)
    return expected


def test_parts_are_joined() -> None:
    parts = make_result(5), make_result(2, narrow=True)
    joined = assert_equal_on_device(
        lambda first, other: merge_results(5, [(np.arange(5), first), (ROWS, other)]), *parts
    )
    assert joined.infos["giver"]["term"].dtype == np.float64
    np.testing.assert_array_equal(joined.observations["receiver"][ROWS], parts[1].observations["receiver"])


def test_rows_are_selected() -> None:
    result = make_result(5)
    assert_equal_on_device(lambda found: select_rows(found, ROWS), result)
    assert_equal_on_device(lambda found: select_rows(found, 3), result)


def test_rows_are_replaced_in_copies() -> None:
    first, other = make_result(5), make_result(2)
    before = first.observations["receiver"].copy()
    assert_equal_on_device(lambda one, two: replace_rows(one, ROWS, two), first.observations, other.observations)
    np.testing.assert_array_equal(first.observations["receiver"], before)


def test_ends_are_on_the_host() -> None:
    result = make_result(40)
    ended = move_to_device(result, make_tensor_factory("cuda")).ended
    assert type(ended) is np.ndarray
    np.testing.assert_array_equal(ended, result.ended, strict=True)
    assert 0 < ended.sum() < 40
