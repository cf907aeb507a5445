"""Tests of custom features and action schemes: accepted forms, and errors that name them."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import handover_marl
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import EncodingError, OptionError, UnknownNameError
from handover_marl.learning.adapters.function_policy import LearnedPolicy
from handover_marl.learning.custom_encodings import FeatureExtractor, declare_size
from handover_marl.learning.features import make_features
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from handover_marl.learning.schemes import make_scheme
from handover_marl.receivers import make_policy_context
from tests.givers.test_givers import START, seen
from tests.learning.custom import FirstJoint, OffsetAndCount, move_first_joint, offset_to_object

CONTEXT = make_policy_context(SyntheticDataset())
MODULE = "tests.learning.custom"
SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}


def features_that(result: Any, size: int = 2) -> Any:
    @declare_size(size)
    def mine(observation: Any) -> Any:
        return result

    return mine


@pytest.mark.parametrize(
    ("choice", "name", "size"),
    [
        (offset_to_object, "offset_to_object", 3),
        (OffsetAndCount, "OffsetAndCount", 4),
        (f"{MODULE}:offset_to_object", f"{MODULE}:offset_to_object", 3),
        (f"{MODULE}:OffsetAndCount", f"{MODULE}:OffsetAndCount", 4),
    ],
)
def test_forms_of_own_features(choice: Any, name: str, size: int) -> None:
    made = make_features("receiver", choice, CONTEXT)
    assert (made.name, made.size, made.space.shape) == (name, size, (size,))
    np.testing.assert_array_equal(made(seen())[:3], offset_to_object(seen()))


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (np.zeros(3, np.float32), r"'features_that.*mine' must be a float32 array of shape \(2,\), got float32 \(3,\)"),
        (np.zeros(2), r"must be a float32 array of shape \(2,\), got float64 \(2,\); convert with"),
        ([0.0, 1.0], r"got list"),
        (np.array([0.0, np.nan], np.float32), r"mine' must be finite, got nan in component 1"),
    ],
)
def test_wrong_features_are_reported_with_their_name(result: Any, message: str) -> None:
    made = make_features("receiver", features_that(result), CONTEXT)
    with pytest.raises(EncodingError, match=message):
        made(seen())


def test_features_stay_within_a_declared_space() -> None:
    class Bounded(FeatureExtractor):
        space = spaces.Box(-1.0, 1.0, (2,), np.float32)

        def __call__(self, observation: Any) -> np.ndarray:
            return np.array([0.0, 1.5], dtype=np.float32)

    made = make_features("giver", Bounded, CONTEXT)
    assert made.space == Bounded.space
    with pytest.raises(EncodingError, match=r"'.*Bounded' must be within their space, got 1.5 in component 1"):
        made(seen())


def test_features_that_fail_are_named() -> None:
    @declare_size(1)
    def broken(observation: Any) -> Any:
        return observation["nothing"]

    with pytest.raises(EncodingError, match=r"features '.*broken' failed \(KeyError: 'nothing'\)"):
        make_features("receiver", broken, CONTEXT)(seen())

    class Unmakable(OffsetAndCount):
        def __init__(self, context: Any) -> None:
            raise RuntimeError("no weights")

    with pytest.raises(EncodingError, match=r"'.*Unmakable' cannot be made \(RuntimeError: no weights\)"):
        make_features("receiver", Unmakable, CONTEXT)


class NoSize(FeatureExtractor):
    def __call__(self, observation: Any) -> Any: ...


@pytest.mark.parametrize(
    ("make", "choice", "message"),
    [
        (make_features, len, "features 'len' must declare the number of features"),
        (make_features, NoSize, "features 'NoSize' must declare the number of features"),
        (make_features, type("Abstract", (FeatureExtractor,), {"size": 3}), "'Abstract' must define __call__"),
        (make_features, 5, "features must be a name, a class or a function, got 5"),
        (make_scheme, len, "action scheme 'len' must declare the number of outputs"),
        (make_scheme, OffsetAndCount, r"must be a name, a subclass of .*ActionScheme or a function"),
    ],
)
def test_incomplete_choices_are_refused(make: Any, choice: Any, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        make("receiver", choice, CONTEXT)


def test_other_agents_and_unknown_names() -> None:
    with pytest.raises(OptionError, match="'OffsetAndCount' must be for the giver, got some for the receiver"):
        make_features("giver", OffsetAndCount, CONTEXT)
    with pytest.raises(OptionError, match="'first_joint' must be for the giver, got some for the receiver"):
        make_scheme("giver", FirstJoint, CONTEXT)
    with pytest.raises(UnknownNameError, match="features of the receiver 'nothing'; valid: receiver"):
        make_features("receiver", "nothing", CONTEXT)
    for text in ("no_such_module:x", f"{MODULE}:nothing", ":", "a:"):
        with pytest.raises(UnknownNameError, match="it cannot be imported"):
            make_features("receiver", text, CONTEXT)


@pytest.mark.parametrize("choice", [FirstJoint, move_first_joint, f"{MODULE}:FirstJoint", f"{MODULE}:move_first_joint"])
def test_forms_of_own_schemes(choice: Any) -> None:
    scheme = make_scheme("receiver", choice, CONTEXT)
    assert scheme.size == 1
    assert scheme.needs_outputs(seen())
    np.testing.assert_array_equal(scheme.compute_action(seen()), START)
    scheme.set_outputs(np.array([3.0]))
    assert scheme.compute_action(seen())[0] == pytest.approx(START[0] + 0.1)
    scheme.reset()
    np.testing.assert_array_equal(scheme.compute_action(seen()), START)


def test_encode_accepts_own_features_and_schemes() -> None:
    env = handover_marl.encode(handover_marl.parallel_env(**SYNTHETIC), {"receiver": OffsetAndCount}, {})
    assert env.observation_space("receiver").shape == (4,)
    names = {agent: env.action_space(agent).encoding["features"] for agent in env.possible_agents}
    assert names == {"giver": "giver", "receiver": "OffsetAndCount"}
    alone = handover_marl.freeze(handover_marl.parallel_env(**SYNTHETIC), "receiver", "replay")
    own = handover_marl.encode(alone, OffsetAndCount, move_first_joint, api="gymnasium")
    assert (own.observation_space.shape, own.action_space.shape) == ((4,), (1,))
    for _ in range(2):
        first, _ = own.reset(seed=0)
        second, *_ = own.step(np.ones(1, np.float32))
        assert (first[3], second[3]) == (1.0, 2.0), "memory was cleared at the reset"
        assert own.observation_space.contains(second)
    own.close()


def test_camera_data_alone_suffices_for_own_features() -> None:
    @declare_size(7)
    def pose(observation: Any) -> Any:
        return observation["gripper_pose"]

    alone = handover_marl.freeze(handover_marl.parallel_env(obs_mode="pointcloud", **SYNTHETIC), "receiver", "replay")
    assert handover_marl.encode(alone, pose).observation_space("receiver").shape == (7,)
    with pytest.raises(OptionError, match="obs_mode must include the state"):
        handover_marl.encode(alone, pose, "grasp_servo")


def test_environments_of_a_batch_do_not_share_memory() -> None:
    pytest.importorskip("mujoco", reason="needs MuJoCo")
    instance = OffsetAndCount(CONTEXT)
    for choice in (OffsetAndCount, instance):
        envs = handover_marl.vector_env(
            3, "receiver", "replay", features=choice, schemes=FirstJoint, dataset="synthetic", threads=1
        )
        features, _ = envs.reset(seed=0)
        np.testing.assert_array_equal(features[:, 3], 1.0)
        features, *_ = envs.step(np.zeros((3, 1), np.float32))
        np.testing.assert_array_equal(features[:, 3], 2.0)
        envs.close()


def test_trusted_policy_files_import_own_features(tmp_path: Any) -> None:
    network = DenseNetwork((np.zeros((1, 4), np.float32),), (np.zeros(1, np.float32),))
    path = tmp_path / "policy.npz"
    write_policy(path, PolicySpec("receiver", f"{MODULE}:OffsetAndCount", f"{MODULE}:FirstJoint"), network)
    policy = LearnedPolicy("receiver", CONTEXT, path, trust=True)
    policy.reset()
    np.testing.assert_array_equal(policy.act(seen()), START)
