"""Tests of policy files, which are read without running code in them, and of policies with one network for a batch."""

import functools
import itertools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import handover_marl
from handover_marl import givers
from handover_marl.config import WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import ActionError, DataFormatError, HandoverError, OptionError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory, to_numpy
from handover_marl.learning.adapters.function_policy import LearnedPolicy
from handover_marl.learning.adaptive_giver import OFFER_FEATURES
from handover_marl.learning.encodings.registry import count_features, count_outputs
from handover_marl.learning.policy_files import (
    ACTIVATIONS,
    DenseNetwork,
    InputNormalization,
    OutputBounds,
    PolicySpec,
    read_policy,
    write_policy,
)
from handover_marl.policies.batch import ArrayPolicyBatch, make_policy_batch
from handover_marl.policies.reference import parse_policy
from tests.helpers.tensors import make_device_tensors, make_observe_function
from tests.learning.array_encodings import CONTEXT, COUNT, ROWS, SCHEMES, draw_observation, select
from tests.learning.custom import FirstJoint

RAN = "HANDOVER_MARL_TEST_CODE_RAN"


class Evil:
    """Object that runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"import os; os.environ[{RAN!r}] = '1'",)


@pytest.fixture(autouse=True)
def _no_code_ran(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.delenv(RAN, raising=False)
    yield
    assert RAN not in os.environ
    monkeypatch.delenv(RAN, raising=False)


def test_written_policy_is_read_back(tmp_path: Path) -> None:
    spec = PolicySpec("receiver", "grasp", "cartesian_delta", 0.2, "a test")
    wanted = replace(draw_network(count_features("receiver", "grasp"), 7, 0, "relu"), output="tanh")
    write_policy(tmp_path / "policy.npz", spec, wanted)
    found, function, label = read_policy(tmp_path / "policy.npz", "receiver")
    assert found == spec
    assert label.startswith("policy@")
    seen = np.linspace(-1, 1, wanted.n_inputs, dtype=np.float32)
    np.testing.assert_array_equal(function(seen), wanted(seen))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": "smell"}, "features of the giver 'smell'; valid: giver"),
        ({"features": OFFER_FEATURES}, "of train_giver_offers.py; pass adaptive:weights=.*policy.npz"),
        ({"actions": "cartesian_delta"}, "action scheme of the giver"),
        ({"actions": "deviation"}, "must have 39 inputs and 8 outputs, got 39 and 7"),
        ({"agent": "receiver"}, "policy must be for the giver, got one for the receiver"),
        ({"control_period": -1.0}, "control_period must be a time from 0.001 to 5 s, got -1.0"),
    ],
)
def test_policies_that_do_not_fit_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    spec = PolicySpec(**({"agent": "giver", "features": "giver", "actions": "offer"} | change))
    write_policy(tmp_path / "policy.npz", spec, draw_network(39, 7, 0))
    with pytest.raises(HandoverError, match=message):
        givers.make(f"learned:{tmp_path / 'policy.npz'}")


@given(st.binary(max_size=300))
def test_random_bytes_are_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "policy.npz"
    path.write_bytes(content)
    with pytest.raises(DataFormatError):
        read_policy(path, "giver")


def test_pickles_in_npz_files_are_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    np.savez(path, about=np.array([Evil()], dtype=object))
    with pytest.raises(DataFormatError, match="not a readable policy file"):
        givers.make(f"learned:{path}", trust=True)


def test_files_of_other_libraries_are_loaded_by_these(tmp_path: Path) -> None:
    path = tmp_path / "policy.zip"
    path.write_bytes(b"PK")
    for make in (lambda: givers.make(f"learned:{path}"), lambda: handover_marl.as_giver(path)):
        with pytest.raises(OptionError, match=r"such as PPO\.load, and pass it to handover_marl\.as_giver"):
            make()


#: Features and action schemes, each of them at least once.
PAIRS = [
    *(("giver", "giver", "offer"), ("giver", "flat_giver", "giver"), ("giver", "giver", "deviation")),
    *(
        ("receiver", "receiver", "joints"),
        ("receiver", "flat_receiver", "receiver"),
        ("receiver", "grasp", "joint_delta"),
    ),
    *(("receiver", "close", "cartesian_delta"), ("receiver", "close_stack", "grasp_servo")),
]


def draw_network(n_inputs: int, n_outputs: int, seed: int, activation: str = "tanh") -> DenseNetwork:
    rng = np.random.default_rng(seed)
    sizes = [n_inputs, 32, 16, n_outputs]
    weights = tuple(
        (rng.normal(size=(after, before)) / np.sqrt(before)).astype(np.float32)
        for before, after in itertools.pairwise(sizes)
    )
    biases = tuple(rng.normal(0.0, 0.3, size).astype(np.float32) for size in sizes[1:])
    normalization = bounds = None
    if seed % 2:
        spread = rng.uniform(0.5, 2.0, n_inputs)
        normalization = InputNormalization(rng.normal(size=n_inputs), spread, np.full(n_inputs, 3.0))
        ones = np.ones(n_outputs, dtype=np.float32)
        bounds = OutputBounds(-ones, ones, is_scaled=bool(seed % 4 == 1))
    return DenseNetwork(weights, biases, activation, "identity", normalization, bounds)


def write(path: Path, agent: str, features: str, scheme: str, network: DenseNetwork) -> Path:
    write_policy(path, PolicySpec(agent, features, scheme, 0.1), network)
    return path


@given(
    seed=st.integers(0, 10_000),
    rows=st.integers(1, 40),
    sizes=st.tuples(st.integers(1, 130), st.integers(1, 70)),
    activation=st.sampled_from(sorted(ACTIVATIONS)),
)
def test_a_network_of_many_inputs_equals_one_of_each_to_the_bit(
    seed: int, rows: int, sizes: tuple[int, int], activation: str
) -> None:
    network = draw_network(*sizes, seed, activation)
    inputs = np.random.default_rng(seed).normal(0.0, 2.0, (rows, sizes[0])).astype(np.float32)
    found = network(inputs)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.stack([network(one) for one in inputs]))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_network_of_tensors_has_the_same_outputs(activation: str) -> None:
    for seed in range(4):
        network = replace(draw_network(30, 7, seed, activation), output=activation if seed < 2 else "identity")
        inputs = np.random.default_rng(seed).normal(0.0, 2.0, (7, 30)).astype(np.float32)
        with make_device_tensors() as tensors:
            found = to_numpy(network.copy_to(tensors)(tensors.asarray(inputs)))
        assert found.dtype == np.float32
        expected = network(inputs)
        # Sums of large terms that cancel each other are as accurate as the terms.
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * (1.0 + np.abs(expected).max()))


def make_network_batch(policy: LearnedPolicy) -> ArrayPolicyBatch:
    assert policy.is_batchable
    return ArrayPolicyBatch(policy.copy_for(COUNT, NUMPY_ARRAYS), COUNT, policy.scheme.agent)


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "features", "scheme"), PAIRS)
def test_a_batch_acts_as_single_policies(agent: str, features: str, scheme: str, tmp_path: Path) -> None:
    assert {pair[::2] for pair in PAIRS} == set(SCHEMES)
    network = draw_network(count_features(agent, features), count_outputs(agent, scheme), len(features + scheme))
    path = write(tmp_path / "policy.npz", agent, features, scheme, network)
    singles = {row: LearnedPolicy(agent, CONTEXT, path) for row in range(0, COUNT, 4)}
    batch, alone = (make_network_batch(singles[0]) for _ in range(2))
    some = np.array([5])
    for episode in range(2):
        for row, single in singles.items():
            single.reset(row)
        for row in ROWS.tolist():
            batch.reset(row, row, ("025_mug",))
            alone.reset(row, row, ("025_mug",))
        for decision in range(3):
            observation = draw_observation(8 * episode + decision)
            steps = np.full(COUNT, 100 * decision)
            found, _ = batch.act(ROWS, functools.partial(select, observation), steps)
            expected = np.stack([single.act(select(observation, row)) for row, single in singles.items()])
            np.testing.assert_allclose(found[[*singles]], expected, rtol=1e-5, atol=1e-5)
            by_itself, _ = alone.act(some, functools.partial(select, observation), steps[some])
            np.testing.assert_array_equal(by_itself, found[some])
            # The action is held until the next decision.
            held, _ = batch.act(ROWS, functools.partial(select, draw_observation(99)), steps + 99)
            np.testing.assert_array_equal(held, found)


def make_batch(policy: Any, agent: str = "receiver", arrays: ArrayFactory = NUMPY_ARRAYS) -> Any:
    reference = parse_policy(agent, policy, trust=True)
    return make_policy_batch(reference, SyntheticDataset(), WorldConfig(), "s0", 2, arrays)


def test_a_batch_waits_as_the_option_says(tmp_path: Path) -> None:
    network = draw_network(count_features("receiver", "close"), 7, 0)
    path = write(tmp_path / "policy.npz", "receiver", "close", "grasp_servo", network)
    batch = make_network_batch(LearnedPolicy("receiver", CONTEXT, path, wait=0.5))
    usual = make_network_batch(LearnedPolicy("receiver", CONTEXT, path))
    observation = draw_observation(0) | {"time": np.full((COUNT, 1), 0.6, dtype=np.float32)}
    acted, waited = (one.act(ROWS, functools.partial(select, observation), 0 * ROWS)[0] for one in (batch, usual))
    assert (acted != waited).any(axis=1).sum() > COUNT // 2


def test_own_action_schemes_wait_as_the_option_says() -> None:
    class Late(FirstJoint):
        wait = 2.0

    policy = handover_marl.as_receiver(lambda observation: np.zeros(1), action_scheme=Late, name="late")
    made: Any = parse_policy("receiver", (policy, {"wait": 0.5})).make(SyntheticDataset())
    made.allocate(2, NUMPY_ARRAYS)
    assert [made.wait, *(scheme.wait for scheme in made.scheme._schemes)] == [0.5, 0.5, 0.5]


def test_outputs_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    huge = np.full((9, count_features("receiver", "receiver")), 3e38, dtype=np.float32)
    network = DenseNetwork((huge,), (np.zeros(9, dtype=np.float32),))
    path = write(tmp_path / "policy.npz", "receiver", "receiver", "receiver", network)
    observation = draw_observation(0)
    with make_device_tensors() as tensors:
        for policy, arrays in itertools.product(
            (f"learned:{path}", handover_marl.as_receiver(path)), (NUMPY_ARRAYS, tensors)
        ):
            batch, rows = make_batch(policy, arrays=arrays), arrays.arange(2)
            with np.errstate(all="ignore"), pytest.raises(ActionError, match="finite"):
                batch.act(rows, make_observe_function(observation, arrays), 0 * rows)
