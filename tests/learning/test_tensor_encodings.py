"""Tests of features and action schemes on PyTorch tensors: they equal those on NumPy arrays."""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import ArrayFactory, is_tensor, to_numpy
from handover_marl.learning.features import make_array_features
from handover_marl.learning.grasp_selector import LowestCostGraspSelector
from handover_marl.learning.schemes import make_array_scheme
from tests.helpers.tensors import make_device_tensors
from tests.learning.array_encodings import CONTEXT, FEATURES, SCHEMES, draw_observation, select

COUNT, N_STATES = 6, 14


@functools.cache
def draw_observations() -> list[Observation]:
    """Return random observations (COUNT, ...), in every second one of which grippers are near grasps."""
    rng, found = np.random.default_rng(0), []
    for seed in range(N_STATES):
        found.append(select(draw_observation(seed), np.arange(COUNT)))
        if seed % 2:
            grasps, _, exists = LowestCostGraspSelector(CONTEXT, COUNT).select(np.arange(COUNT), found[-1])
            found[-1]["gripper_pose"][exists] = grasps[exists] + rng.normal(scale=0.03, size=(exists.sum(), 7))
    return found


@pytest.fixture
def arrays() -> Iterator[ArrayFactory]:
    with make_device_tensors() as factory:
        yield factory


def iterate_steps(arrays: ArrayFactory, *batches: Any) -> Iterator[tuple[np.ndarray, Observation, Any, Any]]:
    """Yield rows and observations of some episodes on the host and as tensors; reset some episodes before."""
    rng = np.random.default_rng(1)
    for drawn in draw_observations():
        for row in np.flatnonzero(rng.random(COUNT) < 0.1).tolist():
            for batch in batches:
                batch.reset(row)
        rows = rng.permutation(COUNT)[: rng.integers(1, COUNT + 1)]
        observation = select(drawn, rows)
        tensors = {key: arrays.asarray(values) for key, values in observation.items()}
        yield rows, observation, arrays.asarray(rows), tensors


def assert_equal(found: Any, expected: np.ndarray, tolerance: float = 2e-6) -> None:
    assert is_tensor(found)
    own = to_numpy(found)
    assert own.dtype == expected.dtype
    np.testing.assert_allclose(own, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "name"), FEATURES)
def test_features_of_tensors(agent: str, name: str, arrays: ArrayFactory) -> None:
    host = make_array_features(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT), COUNT)
    batch = make_array_features(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT, arrays), COUNT, arrays)
    for rows, observation, own_rows, tensors in iterate_steps(arrays, host, batch):
        assert_equal(batch(own_rows, tensors), host(rows, observation))


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "name"), SCHEMES)
def test_actions_of_tensors(agent: str, name: str, arrays: ArrayFactory) -> None:
    host = make_array_scheme(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT), COUNT)
    batch = make_array_scheme(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT, arrays), COUNT, arrays)
    rng, n_outputs = np.random.default_rng(2), 0
    for rows, observation, own_rows, tensors in iterate_steps(arrays, host, batch):
        needs, own_needs = host.needs_outputs(rows, observation), batch.needs_outputs(own_rows, tensors)
        assert_equal(own_needs, needs)
        outputs = rng.uniform(-1.3, 1.3, (needs.sum(), host.size)).astype(np.float32)
        n_outputs += len(outputs)
        host.set_outputs(rows[needs], outputs)
        batch.set_outputs(own_rows[own_needs], arrays.asarray(outputs))
        assert_equal(batch.compute_actions(own_rows, tensors), host.compute_actions(rows, observation))
    assert n_outputs > COUNT


def test_selections_of_tensors(arrays: ArrayFactory) -> None:
    host, batch = LowestCostGraspSelector(CONTEXT, COUNT), LowestCostGraspSelector(CONTEXT, COUNT, arrays)
    n_grasps = 0
    for rows, observation, own_rows, tensors in iterate_steps(arrays):
        expected, found = host.select(rows, observation), batch.select(own_rows, tensors)
        n_grasps += int(expected[2].sum())
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other, 1e-9)
    assert n_grasps > COUNT
