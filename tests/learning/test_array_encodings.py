"""Tests of features, action schemes and selected grasps of many episodes, on arrays and on tensors.

Episodes do not depend on each other, and tensors have the values of arrays.
"""

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import ArrayFactory, is_tensor, to_numpy
from handover_marl.geometry.panda import HALF_TURN
from handover_marl.geometry.poses import compose
from handover_marl.grasps.graspable_object import compute_hold_costs, load_graspable_object
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.grasps.selector import MAX_CLEARANCE, LowestCostGraspSelector
from handover_marl.learning.encodings.registry import make_action_scheme, make_array_features, make_array_scheme
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.planning.robot_clearance import Spheres, compute_grasp_clearances
from tests.helpers.tensors import make_device_tensors
from tests.learning.array_encodings import (
    CONTEXT,
    COUNT,
    FEATURES,
    ROWS,
    SCHEMES,
    SingleFeatures,
    draw_observation,
    select,
)

pytestmark = pytest.mark.slow


def test_selected_grasps_have_the_lowest_cost() -> None:
    """Every grasp that would cost less than the selected one, if it were in reach, is out of reach."""
    observation, n_grasps, n_unreachable = draw_observation(4), 0, 0
    # The objects are near the grippers.
    observation["object_poses"][:, 0, :3] = observation["gripper_pose"][:, :3] + np.float32([0.0, 0.2, 0.1])
    grasps, clearances, exists = LowestCostGraspSelector(CONTEXT, COUNT).select(ROWS, observation)
    arm = ArmInWorld.for_panda(CONTEXT.panda_urdf, CONTEXT.panda, 0.03)
    for row in ROWS.tolist():
        one = {key: values.astype(float) for key, values in select(observation, row).items()}
        name = CONTEXT.object_names[int(one["object_classes"][0])]
        assert exists[row] == (load_hand_poses(CONTEXT.load_grasps, name) is not None)
        if not exists[row]:
            continue
        n_grasps += 1
        graspable = load_graspable_object(CONTEXT, name)
        known = graspable.grasps.poses
        poses = compose(one["object_poses"][0], np.concatenate([known, compose(known, np.array(HALF_TURN))]))
        turns = Rotation.from_quat(one["gripper_pose"][3:]).inv() * Rotation.from_quat(poses[:, 3:])
        free = np.full(len(poses), MAX_CLEARANCE)
        if one["hand_present"][0]:
            fingers = Spheres(one["hand_keypoints"], np.full(16, 0.012))
            free = compute_grasp_clearances(poses, fingers, 0.08, flange=False).clip(None, MAX_CLEARANCE)
        costs = np.linalg.norm(poses[:, :3] - one["gripper_pose"][:3], axis=1) + 0.25 * turns.magnitude()
        costs += 0.1 * np.tile(compute_hold_costs(graspable.grasps, graspable.pad_margins), 2)
        costs += 10.0 * np.maximum(0.03 - free, 0.0) + 5.0 * (free < 0.003)
        away = np.linalg.norm(poses[:, :3] - grasps[row, :3], axis=1) + 1.0 - np.abs(poses[:, 3:] @ grasps[row, 3:])
        found = int(np.argmin(away))
        assert away[found] < 1e-6
        np.testing.assert_allclose(clearances[row], free[found], atol=1e-6)
        cheaper = poses[costs < costs[found] - 1e-6]
        starts = np.tile(one["robot_joint_position"][:7], (len(cheaper), 1))
        assert not arm.solve(cheaper, starts, 4)[1].any()
        n_unreachable += len(cheaper)
    assert 0 < n_grasps < COUNT
    assert n_unreachable


@pytest.mark.parametrize(("agent", "name"), FEATURES)
def test_features_do_not_depend_on_other_episodes(agent: str, name: str) -> None:
    singles = {row: SingleFeatures(agent, name, CONTEXT) for row in range(0, COUNT, 4)}
    together = make_array_features(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT), COUNT)
    for seed in range(2):
        observation = draw_observation(seed)
        found = together(ROWS, observation)[[*singles]]
        expected = np.stack([single(select(observation, row)) for row, single in singles.items()])
        np.testing.assert_array_equal(found, expected, strict=True)


@pytest.mark.parametrize(("agent", "name"), SCHEMES)
def test_actions_do_not_depend_on_other_episodes(agent: str, name: str) -> None:
    singles = [make_action_scheme(agent, name, CONTEXT) for _ in ROWS]
    together = make_array_scheme(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT), COUNT)
    rng = np.random.default_rng(0)
    for episode in range(2):
        for row in ROWS.tolist():
            together.reset(row)
            singles[row].reset()
        for seed in range(3):
            observation = draw_observation(3 * episode + seed)
            outputs = rng.uniform(-1.3, 1.3, (COUNT, together.size)).astype(np.float32)
            needs = together.needs_outputs(ROWS, observation)
            expected = []
            for row, scheme in enumerate(singles):
                one = select(observation, row)
                assert scheme.needs_outputs(one) == needs[row]
                if needs[row]:
                    scheme.set_outputs(outputs[row])
                expected.append(scheme.compute_action(one))
            together.set_outputs(ROWS[needs], outputs[needs])
            np.testing.assert_array_equal(together.compute_actions(ROWS, observation), np.stack(expected), strict=True)


N_ROWS, N_STATES = 6, 4


@functools.cache
def draw_observations() -> list[Observation]:
    """Return random observations (N_ROWS, ...), in every second one of which grippers are near grasps."""
    rng, found = np.random.default_rng(0), []
    for seed in range(N_STATES):
        found.append(select(draw_observation(seed), np.arange(N_ROWS)))
        if seed % 2:
            grasps, _, exists = LowestCostGraspSelector(CONTEXT, N_ROWS).select(np.arange(N_ROWS), found[-1])
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
        for row in np.flatnonzero(rng.random(N_ROWS) < 0.1).tolist():
            for batch in batches:
                batch.reset(row)
        rows = rng.permutation(N_ROWS)[: rng.integers(1, N_ROWS + 1)]
        observation = select(drawn, rows)
        tensors = {key: arrays.asarray(values) for key, values in observation.items()}
        yield rows, observation, arrays.asarray(rows), tensors


def assert_equal(found: Any, expected: np.ndarray, tolerance: float = 2e-6) -> None:
    assert is_tensor(found)
    own = to_numpy(found)
    assert own.dtype == expected.dtype
    np.testing.assert_allclose(own, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(("agent", "name"), FEATURES)
def test_features_of_tensors(agent: str, name: str, arrays: ArrayFactory) -> None:
    host = make_array_features(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, N_ROWS), N_ROWS)
    batch = make_array_features(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, N_ROWS, arrays), N_ROWS, arrays)
    for rows, observation, own_rows, tensors in iterate_steps(arrays, host, batch):
        assert_equal(batch(own_rows, tensors), host(rows, observation))


@pytest.mark.parametrize(("agent", "name"), SCHEMES)
def test_actions_of_tensors(agent: str, name: str, arrays: ArrayFactory) -> None:
    host = make_array_scheme(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, N_ROWS), N_ROWS)
    batch = make_array_scheme(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, N_ROWS, arrays), N_ROWS, arrays)
    rng, n_outputs = np.random.default_rng(2), 0
    for rows, observation, own_rows, tensors in iterate_steps(arrays, host, batch):
        needs, own_needs = host.needs_outputs(rows, observation), batch.needs_outputs(own_rows, tensors)
        assert_equal(own_needs, needs)
        outputs = rng.uniform(-1.3, 1.3, (needs.sum(), host.size)).astype(np.float32)
        n_outputs += len(outputs)
        host.set_outputs(rows[needs], outputs)
        batch.set_outputs(own_rows[own_needs], arrays.asarray(outputs))
        assert_equal(batch.compute_actions(own_rows, tensors), host.compute_actions(rows, observation))
    assert n_outputs > N_ROWS // 2


def test_selections_of_tensors(arrays: ArrayFactory) -> None:
    host, batch = LowestCostGraspSelector(CONTEXT, N_ROWS), LowestCostGraspSelector(CONTEXT, N_ROWS, arrays)
    n_grasps = 0
    for rows, observation, own_rows, tensors in iterate_steps(arrays):
        expected, found = host.select(rows, observation), batch.select(own_rows, tensors)
        n_grasps += int(expected[2].sum())
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other, 1e-9)
    assert n_grasps > N_ROWS
