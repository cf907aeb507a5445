"""Tests of environments whose episodes are tensors on a device, against environments of NumPy arrays.

Physics is the same on both sides, so that all results agree to the accuracy of the arrays' functions.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

import torch
from gymnasium import spaces

import handover_marl
from handover_marl.config import PhysicsConfig, ProtocolConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.envs.custom_rewards import combine_rewards
from handover_marl.envs.transition import Transition
from handover_marl.envs.vector.env_result import check_action_array
from handover_marl.episode import episode_batch
from handover_marl.errors import ActionError
from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory, make_tensor_factory, to_numpy
from handover_marl.geometry.panda import WAITING_JOINTS
from handover_marl.simulation.engines import BatchBackend, make_world_batch
from handover_marl.simulation.reference_tracking import ReferenceMotion
from handover_marl.simulation.world import Contacts, JudgeFunction, RolloutContacts, RolloutEnd, WorldState
from tests.helpers.fake_device import DEVICE, DeviceTensor, FakeDevice
from tests.learning.custom import move_first_joint, offset_to_object

COUNT = 4
OPTIONS: dict[str, Any] = {"setup": "s0", "split": "train", "dataset": "synthetic", "threads": 1, "rewards": "shaped"}
#: Options of short episodes, so that all of them end and new ones start.
SHORT: dict[str, Any] = {**OPTIONS, "max_cycles": 6, "control_period": 0.1}
#: Options of episodes in which the receiver acts after it has waited, and in which all episodes end.
ENCODED: dict[str, Any] = {**SHORT, "control_period": 0.2}


class TensorWorlds:
    """Worlds that take and return tensors on a device; arguments as for `make_world_batch`."""

    def __init__(self, config: PhysicsConfig, count: int, backend: BatchBackend, arrays: ArrayFactory) -> None:
        self._worlds, self._arrays = make_world_batch(config, count, backend, NUMPY_ARRAYS), arrays

    def reset(self, row: int, scene: Scene, start: ReferenceMotion, robot_joints: Sequence[float]) -> None:
        assert type(row) is int
        self._worlds.reset(row, scene, start, robot_joints)

    def rollout(
        self, rows: Any, reference: ReferenceMotion, robot_targets: Any, judge: JudgeFunction, rules: ProtocolConfig
    ) -> Any:
        def judge_on_device(indices: Any, contacts: RolloutContacts) -> RolloutEnd:
            end = judge(self._arrays.asarray(indices), RolloutContacts(*map(self._arrays.asarray, contacts)))
            return RolloutEnd(*map(to_numpy, end))

        targets = ReferenceMotion(*(_read(getattr(reference, name)) for name in ("objects", "hand", "hand_present")))
        moved = _read(robot_targets, "float32")
        simulated = self._worlds.rollout(_read(rows, "int64"), targets, moved, judge_on_device, rules)
        return self._arrays.asarray(simulated)

    def release_targets(self, rows: Any) -> None:
        self._worlds.release_targets(_read(rows, "int64"))

    def read_state(self, rows: Any) -> WorldState:
        return WorldState(*map(self._arrays.asarray, self._worlds.read_state(_read(rows, "int64"))))

    def are_grasped(self, rows: Any) -> Any:
        return self._arrays.asarray(self._worlds.are_grasped(_read(rows, "int64")))

    def read_contacts(self, row: int, released: bool) -> Contacts:
        assert type(row) is int
        return self._worlds.read_contacts(row, released)

    def close(self) -> None:
        self._worlds.close()


def _read(tensor: Any, dtype: str | None = None) -> Any:
    assert isinstance(tensor, DeviceTensor)
    values = to_numpy(tensor)
    assert dtype is None or values.dtype == np.dtype(dtype)
    return values


def assert_same(found: Any, expected: Any, is_on_device: bool = True) -> None:
    """Compare a result on a device with a result as NumPy arrays.

    Args:
        found: Tensors on the device, in dictionaries, tuples and arrays of objects.
        expected: NumPy arrays in the same containers.
        is_on_device: Whether arrays must be on the device; the mask of an array of objects must not.
    """
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            assert_same(found[key], value, is_on_device and key != "_final_obs")
    elif isinstance(expected, (tuple, list)):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_same(one, other, is_on_device)
    elif isinstance(expected, np.ndarray) and expected.dtype == object:
        assert type(found) is np.ndarray
        assert_same(list(found), list(expected), is_on_device)
    elif isinstance(expected, (np.ndarray, np.generic)):
        assert isinstance(found, DeviceTensor if is_on_device else np.ndarray)
        values = to_numpy(found)
        assert (values.dtype, values.shape) == (expected.dtype, expected.shape)
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5)
    else:
        assert type(found) is type(expected)
        assert found == expected or found == pytest.approx(expected, rel=1e-5, abs=1e-5)


@pytest.fixture
def on_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[ArrayFactory]:
    """Make vector environments simulate tensors on a device."""
    with FakeDevice(), monkeypatch.context() as patch:
        arrays = make_tensor_factory(DEVICE.type)
        patch.setattr(episode_batch, "make_world_batch", TensorWorlds)
        patch.setattr(episode_batch, "NUMPY_ARRAYS", arrays)
        yield arrays


def rollout(arrays: ArrayFactory, steps: int, agent: str | None, options: dict[str, Any]) -> list[Any]:
    """Return the results of resets of all and of some environments, and of steps with random actions."""
    envs, rng = handover_marl.vector_env(COUNT, agent, **options), np.random.default_rng(0)

    def draw(space: Any) -> Any:
        # Joint positions near those of the waiting robot.
        middle = np.array(WAITING_JOINTS) if space.shape[1:] == (9,) else 0.0
        return arrays.asarray(middle + 0.3 * rng.normal(size=space.shape), "float32")

    chosen = arrays.asarray(np.array([True, False, True, False]))
    masked = {"reset_mask": chosen, "scene_id": envs.scene_ids[3]}
    resets: list[dict[str, Any]] = [{"seed": 3}] if agent is None else [{"seed": 3}, {"options": masked}]
    found: list[Any] = []
    for arguments in resets:
        found.append(envs.reset(**arguments))
        for _ in range(steps // len(resets)):
            if agent is None:
                found.append(envs.step({one: draw(envs.action_space(one)) for one in envs.possible_agents}))
            else:
                found.append(envs.step(draw(envs.action_space)))
    envs.close()
    return found


def compare(request: pytest.FixtureRequest, steps: int, agent: str | None, options: dict[str, Any]) -> None:
    """Compare a rollout on the device with one of NumPy arrays, in which episodes end."""
    expected = rollout(NUMPY_ARRAYS, steps, agent, options)
    found = rollout(request.getfixturevalue("on_device"), steps, agent, options)
    assert_same(found, expected)
    ended = [end for step in expected if len(step) == 5 for end in step[2:4]]
    flags = ended if agent is not None else [own for end in ended for own in end.values()]
    assert any(one.any() for one in flags), "no episode has ended"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "options"),
    [
        # The partner decides within the control periods of the environments.
        ("receiver", {"partner": "noisy", "control_period": 0.13, "autoreset": "same_step"}),
        ("giver", {"partner": "yang2021:wait=0.2", "autoreset": "next_step", "rewards": "sparse"}),
        (None, {"autoreset": "same_step"}),
        (
            "receiver",
            {"partner": "cooperative", "features": "close", "action_scheme": "grasp_servo", "autoreset": "next_step"},
        ),
        ("giver", {"partner": "hold", "features": "giver", "action_scheme": "offer", "autoreset": "same_step"}),
        (None, {"features": {"giver": "giver", "receiver": "grasp"}, "action_scheme": {"receiver": "joint_delta"}}),
    ],
    ids=str,
)
def test_environments_equal_those_of_arrays(
    request: pytest.FixtureRequest, agent: str | None, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Raw observations and actions, and features and action schemes, have the values of arrays."""
    steps, usual = 16 if agent is not None else 8, SHORT
    if "features" in options:
        # The receiver waits for four cycles; an offer lasts a whole episode. Episodes end, and new ones start.
        monkeypatch.setattr("handover_marl.learning.encodings.schemes.GraspServoScheme.wait", 0.8)
        offering = {**ENCODED, "max_cycles": 5, "control_period": 0.5}
        steps, usual = (2, offering) if options["action_scheme"] == "offer" else (8, ENCODED)
    compare(request, steps, agent, {**usual, **options})


def reward_height(transition: Transition) -> dict[str, dict[str, float]]:
    height = float(transition.next_state["gripper_pose"][2] - transition.state["gripper_pose"][2])
    return {"receiver": {"height": height}, "giver": {"steps": 1e-3 * transition.infos["giver"]["steps"]}}


@pytest.mark.slow
def test_user_defined_parts_act_on_the_host(request: pytest.FixtureRequest) -> None:
    options = {**SHORT, "partner": "tired", "features": offset_to_object, "action_scheme": move_first_joint}
    options |= {"autoreset": "same_step", "rewards": combine_rewards((0.5, reward_height), "sparse")}
    compare(request, 16, "receiver", options)


def test_wrong_numbers_change_nothing(on_device: ArrayFactory) -> None:
    envs = handover_marl.vector_env(2, "receiver", "replay", **SHORT)
    envs.reset(seed=1)
    actions = on_device.asarray(np.tile(np.array(WAITING_JOINTS, np.float32), (2, 1)))
    wrong = torch.where(on_device.arange(9) == 4, torch.nan, actions)
    with pytest.raises(ActionError, match="component 4 is nan, which is not finite"):
        envs.step(wrong)
    with pytest.raises(ActionError, match=r"must have shape \(2, 9\)"):
        envs.step(actions[:1])
    observations, *_ = envs.step(actions)
    np.testing.assert_allclose(observations["time"].tolist(), [[0.1], [0.1]], atol=1e-6)
    envs.close()


ACTIONS = spaces.Box(-np.ones(2, np.float32), np.ones(2, np.float32))


@pytest.mark.usefixtures("on_device")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: torch.zeros(COUNT, 3), r"must have shape \(4, 2\), got torch.float32 \(4, 3\)"),
        (lambda: torch.zeros(COUNT * 2), r"must have shape \(4, 2\), got torch.float32 \(8,\)"),
        (lambda: torch.zeros(COUNT, 2, dtype=torch.bool), r"must have shape \(4, 2\), got torch.bool \(4, 2\)"),
        (lambda: torch.zeros(COUNT, 2, dtype=torch.complex64), "got torch.complex64"),
        (lambda: torch.zeros(COUNT, 2, requires_grad=True), "grad"),
    ],
)
@pytest.mark.parametrize("arrays", [NUMPY_ARRAYS, make_tensor_factory("cuda")], ids=["array", "tensor"])
def test_wrong_tensors_are_refused(make: Callable[[], Any], message: str, arrays: ArrayFactory) -> None:
    error = message.replace("torch.", "") if arrays is NUMPY_ARRAYS else message
    with pytest.raises(ActionError, match=error):
        check_action_array(make(), ACTIONS, COUNT, "receiver", arrays)


@pytest.mark.usefixtures("on_device")
def test_tensors_on_a_device_are_refused_without_a_simulation_there() -> None:
    with pytest.raises(ActionError, match="must be an array"):
        check_action_array(torch.zeros(COUNT, 2, device="cuda"), ACTIONS, COUNT, "receiver")
    assert type(check_action_array(torch.zeros(COUNT, 2), ACTIONS, COUNT, "receiver")) is np.ndarray
