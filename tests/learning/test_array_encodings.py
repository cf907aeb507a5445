"""Tests of features, action schemes and selected grasps of many episodes, which do not depend on each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.geometry.poses import compose, inverse_transform_points
from handover_marl.learning.features import make_array_features, make_features
from handover_marl.learning.grasp_selector import MAX_CLEARANCE, LowestCostGraspSelector
from handover_marl.learning.schemes import make_array_scheme, make_scheme
from handover_marl.receivers.grasp_library import load_hand_poses
from tests.learning.array_encodings import CONTEXT, COUNT, FEATURES, ROWS, SCHEMES, draw_observation, select


def test_selected_grasps_have_the_lowest_cost() -> None:
    observation, n_grasps = draw_observation(4), 0
    grasps, clearances, exists = LowestCostGraspSelector(CONTEXT, COUNT).select(ROWS, observation)
    for row in ROWS.tolist():
        one = select(observation, row)
        known = load_hand_poses(CONTEXT.grasps, CONTEXT.object_names[int(one["object_classes"][0])])
        assert exists[row] == (known is not None)
        if known is None:
            continue
        n_grasps += 1
        half_turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
        poses = compose(one["object_poses"][0].astype(float), np.concatenate([known, compose(known, half_turn)]))
        gripper = one["gripper_pose"].astype(float)
        turns = Rotation.from_quat(gripper[3:]).inv() * Rotation.from_quat(poses[:, 3:])
        free = np.full(len(poses), MAX_CLEARANCE)
        if one["hand_present"][0]:
            local = np.stack([inverse_transform_points(pose, one["hand_keypoints"].astype(float)) for pose in poses])
            local[..., 2] -= local[..., 2].clip(-0.05, 0.11)
            free = np.minimum(np.linalg.norm(local, axis=-1).min(axis=1), MAX_CLEARANCE)
        costs = np.linalg.norm(poses[:, :3] - gripper[:3], axis=1) + 0.25 * turns.magnitude()
        costs += 4.0 * np.maximum(0.09 - free, 0.0)
        away = np.linalg.norm(poses[:, :3] - grasps[row, :3], axis=1) + 1.0 - np.abs(poses[:, 3:] @ grasps[row, 3:])
        found = int(np.argmin(away))
        assert costs[found] <= costs.min() + 1e-6
        np.testing.assert_allclose(clearances[row], free[found], atol=1e-6)
    assert 0 < n_grasps < COUNT


@pytest.mark.parametrize(("agent", "name"), FEATURES)
def test_features_do_not_depend_on_other_episodes(agent: str, name: str) -> None:
    singles = [make_features(agent, name, CONTEXT) for _ in ROWS]
    together = make_array_features(agent, name, CONTEXT, LowestCostGraspSelector(CONTEXT, COUNT), COUNT)
    for seed in range(2):
        observation = draw_observation(seed)
        found = together(ROWS, observation)
        expected = np.stack([single(select(observation, row)) for row, single in enumerate(singles)])
        np.testing.assert_array_equal(found, expected, strict=True)


@pytest.mark.parametrize(("agent", "name"), SCHEMES)
def test_actions_do_not_depend_on_other_episodes(agent: str, name: str) -> None:
    singles = [make_scheme(agent, name, CONTEXT) for _ in ROWS]
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
