"""Tests of custom features and action schemes: accepted forms, and errors that name them."""

from typing import Any

import numpy as np
import pytest

import handover_marl
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import HandoverError, OptionError
from handover_marl.learning.custom_encodings import declare_size
from handover_marl.learning.features import make_features
from handover_marl.learning.schemes import make_scheme
from handover_marl.receivers import make_policy_context
from tests.givers.test_givers import START, seen
from tests.learning.custom import FirstJoint, OffsetAndCount, move_first_joint, offset_to_object

CONTEXT = make_policy_context(SyntheticDataset())
MODULE = "tests.learning.custom"
SYNTHETIC: dict[str, Any] = {"dataset": "synthetic", "physics": "fast", "split": "val"}


@declare_size(1)
def broken(observation: Any) -> Any:
    return observation["nothing"]


class Unmakable(OffsetAndCount):
    def __init__(self, context: Any) -> None:
        raise RuntimeError("no weights")


def features_that(result: Any) -> Any:
    @declare_size(2)
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


@pytest.mark.parametrize(
    ("make", "agent", "choice", "message"),
    [
        *(
            (make_features, "receiver", features_that(result), f"features '.*mine' must be {fault}")
            for result, fault in (
                (np.zeros(2), r"a float32 array of shape \(2,\), got float64 \(2,\); convert with"),
                (np.array([0.0, np.nan], np.float32), "finite, got nan in component 1"),
            )
        ),
        (make_features, "receiver", broken, r"features 'broken' failed \(KeyError: 'nothing'\)"),
        (make_features, "receiver", Unmakable, r"'Unmakable' cannot be made \(RuntimeError: no weights\)"),
        (make_features, "receiver", len, "features 'len' must declare the number of features"),
        (make_features, "giver", OffsetAndCount, "'OffsetAndCount' must be for the giver, got some for the receiver"),
        (make_features, "receiver", "nothing", "features of the receiver 'nothing'; valid: receiver"),
        (make_features, "receiver", "no_such_module:x", "it cannot be imported"),
        (make_scheme, "receiver", OffsetAndCount, "must be a name, a subclass of .*ActionScheme or a function"),
    ],
)
def test_invalid_choices(make: Any, agent: str, choice: Any, message: str) -> None:
    with pytest.raises(HandoverError, match=message):
        make(agent, choice, CONTEXT)(seen())


def test_environments_take_own_features_and_schemes() -> None:
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
    alone = handover_marl.freeze(handover_marl.parallel_env(obs_mode="pointcloud", **SYNTHETIC), "receiver", "replay")
    assert handover_marl.encode(alone, features_that(None)).observation_space("receiver").shape == (2,)
    with pytest.raises(OptionError, match="obs_mode must include the state"):
        handover_marl.encode(alone, features_that(None), "grasp_servo")


@pytest.mark.slow
def test_environments_of_a_batch_do_not_share_memory() -> None:
    pytest.importorskip("mujoco", reason="needs MuJoCo")
    options: dict[str, Any] = {"schemes": FirstJoint, "dataset": "synthetic", "threads": 1}
    envs = handover_marl.vector_env(2, "receiver", "replay", features=OffsetAndCount(CONTEXT), **options)
    assert envs.reset(seed=0)[0][:, 3].tolist() == [1.0, 1.0]
    assert envs.step(np.zeros((2, 1), np.float32))[0][:, 3].tolist() == [2.0, 2.0]
    envs.close()
