"""Tests of observations and spaces: shapes, bounds and values."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces

from handover_marl.config import GiverConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import giver_observation_space, observe, observe_giver_motion, state_space
from handover_marl.episode.spaces import check_giver_action, check_receiver_action, giver_action_space
from handover_marl.errors import ActionError
from handover_marl.simulation.world import WorldState
from tests.episode.one_giver import OneGiver

SHAPES = {
    "robot_joint_position": (9,),
    "robot_joint_velocity": (9,),
    "gripper_pose": (7,),
    "object_poses": (5, 7),
    "object_mask": (5,),
    "object_classes": (5,),
    "hand_dof_position": (51,),
    "hand_keypoints": (16, 3),
    "hand_present": (1,),
    "released": (1,),
    "time": (1,),
}
GIVER_SHAPES = {"replay_wrist_poses": (5, 7), "replay_object_poses": (5, 7), "deviation": (7,), "holding": (1,)}
BOUNDS = {
    **dict.fromkeys(("object_mask", "hand_present", "released", "holding"), (0.0, 1.0)),
    "object_classes": (0.0, 21.0),
    "time": (0.0, np.inf),
}


def make_state(with_hand: bool) -> WorldState:
    rng = np.random.default_rng(0)

    def draw(*shape: int) -> npt.NDArray[np.float32]:
        return rng.normal(size=shape).astype(np.float32)

    robot, gripper, objects = draw(9), draw(7), draw(2, 7)
    hand, keypoints = (draw(51), draw(16, 3)) if with_hand else (None, None)
    return WorldState.from_bodies((robot, draw(9)), gripper, objects, hand, keypoints)


def bounds(space: spaces.Dict) -> dict[str, tuple[float, float]]:
    return {key: (float(box.low.min()), float(box.high.max())) for key, box in space.items()}  # type: ignore[attr-defined]


def test_spaces_have_the_documented_shapes_and_bounds() -> None:
    for space, shapes in ((state_space(), SHAPES), (giver_observation_space(), SHAPES | GIVER_SHAPES)):
        assert {key: box.shape for key, box in space.items()} == shapes
        assert {box.dtype for box in space.values()} == {np.dtype(np.float32)}
        assert bounds(space) == {key: BOUNDS.get(key, (-np.inf, np.inf)) for key in shapes}
    assert bounds(state_space(30))["object_classes"] == (0.0, 30.0)
    assert bounds(giver_observation_space(largest_class=30))["object_classes"] == (0.0, 30.0)


@pytest.mark.parametrize("with_hand", [True, False])
def test_values_of_the_state(with_hand: bool) -> None:
    state = make_state(with_hand)
    found = observe(state, (3, 11), True, 1.5)
    assert state_space().contains(found)
    for key, values in state._asdict().items():
        np.testing.assert_array_equal(found[key], values)
    assert found["object_poses"].any(axis=1).tolist() == [True, True, False, False, False]
    assert found["object_mask"].tolist() == [1, 1, 0, 0, 0]
    assert found["object_classes"].tolist() == [3, 11, 0, 0, 0]
    assert all(found[key].any() == with_hand for key in ("hand_dof_position", "hand_keypoints"))
    assert (found["hand_present"], found["released"], found["time"]) == ([with_hand], [1], [1.5])
    assert observe(state, (3, 11), False, 0.0)["released"] == [0]


def test_values_that_only_the_giver_observes() -> None:
    giver = OneGiver(SyntheticDataset().load_scene(209))
    action = np.array([-0.5, 0.1, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0], dtype=np.float32)
    holding: list[Any] = []
    for steps in (100, 2000, 300):
        giver.plan(steps, action if steps == 300 else np.zeros(8, dtype=np.float32))
        giver.commit(steps)
        found = {key: values[0] for key, values in observe_giver_motion(giver.motion, np.array([0])).items()}
        space = giver_observation_space()
        assert all(space[key].contains(value) for key, value in found.items())
        np.testing.assert_array_equal(found["deviation"], giver.deviation)
        holding += found["holding"].tolist()
    assert holding == [0.0, 1.0, 1.0]
    assert found["deviation"][0] == -0.5
    assert found["deviation"][1] > 0.0
    assert found["deviation"][5] > 0.0


class Tensor:
    """Object that cannot be converted to an array, like a torch tensor with a gradient."""

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad")


@pytest.mark.parametrize("action", [[0.1] * 9, np.full(9, 0.1), np.ones(9, dtype=bool), np.arange(9)])
def test_real_numbers_are_rounded_to_float32(action: object) -> None:
    checked = check_receiver_action(action)
    assert checked.dtype == np.float32
    np.testing.assert_array_equal(checked, np.asarray(action).astype(np.float32))


@pytest.mark.parametrize(
    "action",
    [
        *(["0.1"] * 9, [None] + [0.0] * 8, [10**400] * 9, [[0.0], [0.0, 1.0]]),
        *(np.zeros(9, dtype=complex), np.zeros(9, dtype="datetime64[s]"), Tensor()),
    ],
)
def test_what_is_no_number_is_refused(action: object) -> None:
    with pytest.raises(ActionError, match=r"action of the receiver must be 9 numbers, .*, got "):
        check_receiver_action(action)


def test_what_givers_may_do_can_be_chosen() -> None:
    space = giver_action_space(GiverConfig(displacement=0.1, rotation=0.5))
    np.testing.assert_array_equal(space.high, np.float32([1, 0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 1]))
    np.testing.assert_array_equal(check_giver_action(np.full(8, 9.0), space), space.high)
    np.testing.assert_array_equal(check_giver_action(np.full(8, -9.0), space), space.low)


def test_tensors_on_a_gpu_are_explained() -> None:
    class GpuTensor(Tensor):
        """Tensor that has the method `detach`."""

        def detach(self) -> None: ...

    with pytest.raises(ActionError, match=r"got GpuTensor with a gradient or on a GPU; pass tensor\.detach"):
        check_receiver_action(GpuTensor())
    with pytest.raises(ActionError, match=r"got Tensor$"):
        check_receiver_action(Tensor())
