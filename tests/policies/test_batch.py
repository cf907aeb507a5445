"""Tests of policies in batches of tensors: they act as in batches of NumPy arrays."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.config import WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory, is_tensor, to_numpy
from handover_marl.policies.batch import (
    ArrayPolicyBatch,
    PolicyBatch,
    PopulationBatch,
    SequentialPolicyBatch,
    make_policy_batch,
)
from handover_marl.policies.policy import Giver
from handover_marl.policies.reference import parse_policy
from tests.evaluation.strangers.populations import write_population
from tests.helpers.tensors import make_device_tensors, make_observe_function
from tests.learning.array_encodings import COUNT, draw_observation

DATA = SyntheticDataset()


class CountingGiver(Giver):
    """User-defined giver whose action is the number of its decisions, and the time of the observation."""

    name = "counting"

    def reset(self, seed: int | None = None) -> None:
        self.seed, self.count = seed, 0

    def act(self, observation: Observation) -> np.ndarray:
        assert type(observation["time"]) is np.ndarray
        self.count += 1
        action = np.zeros(8, dtype=np.float32)
        action[1:4] = 0.01 * self.count, 0.001 * (self.seed or 0), 0.01 * observation["time"][0]
        return action


def make_batch(agent: str, policy: Any, arrays: ArrayFactory) -> PolicyBatch:
    return make_policy_batch(parse_policy(agent, policy, trust=True), DATA, WorldConfig(), "s0", COUNT, arrays)


def compare(agent: str, policy: Any) -> list[PolicyBatch]:
    """Compare the actions of some rows after resets of all rows and of single rows; return both batches."""
    with make_device_tensors() as tensors:
        makers = (NUMPY_ARRAYS, tensors)
        batches = [make_batch(agent, policy, arrays) for arrays in makers]
        starts, rng = np.zeros(COUNT, dtype=np.int64), np.random.default_rng(0)
        for decision in range(8):
            observation = draw_observation(decision)
            for row in range(COUNT) if decision == 0 else [decision]:
                starts[row] = 100 * decision
                for batch in batches:
                    batch.reset(row, 10 * decision + row, ("025_mug",))
            rows = rng.permutation(COUNT)[: COUNT // 2 + decision]
            steps = 100 * decision - starts[rows]
            found = [
                batch.act(arrays.asarray(rows), make_observe_function(observation, arrays), arrays.asarray(steps))
                for batch, arrays in zip(batches, makers, strict=True)
            ]
            (expected, due), (actions, tensor_due) = found
            assert is_tensor(actions)
            assert to_numpy(actions).dtype == expected.dtype == np.float32
            np.testing.assert_allclose(to_numpy(actions), expected, rtol=0, atol=1e-6)
            np.testing.assert_array_equal(to_numpy(tensor_due), due)
            assert expected.any()
            assert (due > steps).all()
    return batches


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "policy"), [("receiver", "yang2021:wait=0.5"), ("giver", CountingGiver)])
def test_policies_without_code_for_tensors_act_on_the_host(agent: str, policy: Any) -> None:
    for batch in compare(agent, policy):
        assert type(batch) is (ArrayPolicyBatch if agent == "receiver" else SequentialPolicyBatch)


def test_members_of_a_population_act_on_tensors(tmp_path: Path) -> None:
    path = os.fspath(write_population(tmp_path))
    for batch in compare("giver", ("population", {"population": path, "partners": "all"})):
        assert type(batch) is PopulationBatch
        assert len(np.unique(batch._numbers)) > 1
