"""Tests of the shapes, bounds and values of observations."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import (
    giver_observation_space,
    observe,
    observe_giver_motion,
    state_space,
)
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
