"""Tests of features and action schemes of batches of episodes: they equal those of single episodes."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation, giver_observation_space
from handover_marl.learning.batch.encodings import make_feature_batch, make_scheme_batch
from handover_marl.learning.batch.grasp_selector import LowestCostGraspSelectorBatch
from handover_marl.learning.features import list_features, make_features
from handover_marl.learning.grasp_selector import get_lowest_cost_grasp_selector
from handover_marl.learning.schemes import list_schemes, make_scheme
from handover_marl.policies.policy import make_policy_context
from tests.givers.test_givers import START, seen

CONTEXT = make_policy_context(SyntheticDataset())
SELECTOR = get_lowest_cost_grasp_selector(CONTEXT)
COUNT = 24
ROWS = np.arange(COUNT)


def select(observation: Observation, rows: np.ndarray) -> Observation:
    return {key: values[rows] for key, values in observation.items()}


def draw_observation(seed: int) -> Observation:
    """Draw observations (COUNT, ...) of all keys, with objects with and without grasps."""
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(4 * COUNT, random_state=seed).as_quat().astype(np.float32).reshape(4, COUNT, 4)
    space = giver_observation_space()
    found = {key: rng.normal(size=(COUNT, *own.shape)).astype(np.float32) for key, own in space.items()}
    base = seen()
    for number, key in enumerate(("gripper_pose", "object_poses", "replay_object_poses", "replay_wrist_poses")):
        poses = np.tile(base[key], (COUNT, *[1] * base[key].ndim)) + 0.1 * found[key]
        poses[..., 3:] = rotations[number] if poses.ndim == 2 else rotations[number][:, None]
        found[key] = poses.astype(np.float32)
    found["hand_keypoints"] = (base["hand_keypoints"] + 0.05 * found["hand_keypoints"]).astype(np.float32)
    found["robot_joint_position"] = (START + 0.1 * found["robot_joint_position"]).astype(np.float32)
    found["object_classes"][:] = 0.0
    found["object_classes"][:, 0] = rng.choice([1, 2, 5, 14, 16, 21], COUNT)
    for key in ("hand_present", "released", "holding"):
        found[key] = (rng.random((COUNT, 1)) < 0.7).astype(np.float32)
    found["time"] = rng.uniform(0.0, 5.0, (COUNT, 1)).astype(np.float32)
    return found


def choices(names: dict[str, tuple[str, ...]]) -> Iterator[tuple[str, str]]:
    return ((agent, name) for agent, own in names.items() for name in own)


AGENTS = ("giver", "receiver")
FEATURES = list(choices({agent: list_features(agent) for agent in AGENTS}))
SCHEMES = list(choices({agent: list_schemes(agent) for agent in AGENTS}))


@pytest.mark.parametrize(("agent", "name"), FEATURES)
def test_features_equal_those_of_single_observations(agent: str, name: str) -> None:
    singles = [make_features(agent, name, CONTEXT) for _ in ROWS]
    batch = make_feature_batch(agent, name, CONTEXT, LowestCostGraspSelectorBatch(SELECTOR, COUNT), COUNT)
    for seed in range(5):
        observation = draw_observation(seed)
        found = batch(ROWS, observation)
        expected = np.stack([single(select(observation, row)) for row, single in enumerate(singles)])
        assert found.dtype == expected.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
        some = np.array([7, 2])
        np.testing.assert_array_equal(batch(some, select(observation, some)), found[some])


@pytest.mark.parametrize(("agent", "name"), SCHEMES)
def test_actions_equal_those_of_single_schemes(agent: str, name: str) -> None:
    singles = [make_scheme(agent, name, CONTEXT) for _ in ROWS]
    batch = make_scheme_batch(agent, name, CONTEXT, LowestCostGraspSelectorBatch(SELECTOR, COUNT), COUNT)
    alone = make_scheme_batch(agent, name, CONTEXT, LowestCostGraspSelectorBatch(SELECTOR, COUNT), COUNT)
    rng, some = np.random.default_rng(0), np.array([5])
    for episode in range(2):
        for row in ROWS.tolist():
            for part in (batch, alone):
                part.reset(row)
            singles[row].reset()
        for seed in range(8):
            observation = draw_observation(8 * episode + seed)
            outputs = rng.uniform(-1.3, 1.3, (COUNT, batch.size)).astype(np.float32)
            needs = batch.needs_outputs(ROWS, observation)
            expected = []
            for row, scheme in enumerate(singles):
                one = select(observation, row)
                assert scheme.needs_outputs(one) == needs[row]
                if needs[row]:
                    scheme.set_outputs(outputs[row])
                expected.append(scheme.compute_action(one))
            batch.set_outputs(ROWS[needs], outputs[needs])
            if needs[5]:
                alone.set_outputs(some, outputs[some])
            found = batch.compute_actions(ROWS, observation)
            np.testing.assert_allclose(found, np.stack(expected), rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(alone.compute_actions(some, select(observation, some)), found[some])


def test_selections_are_those_of_the_selector_of_single_episodes() -> None:
    selection = LowestCostGraspSelectorBatch(SELECTOR, COUNT)
    n_grasps = 0
    for seed in range(20):
        observation = draw_observation(seed)
        grasps, clearances, exists = selection.select(ROWS, observation)
        for row in ROWS.tolist():
            expected = SELECTOR.select(select(observation, row))
            assert exists[row] == (expected is not None)
            if expected is not None:
                n_grasps += 1
                np.testing.assert_allclose(grasps[row], expected[0], rtol=0, atol=1e-12)
                np.testing.assert_allclose(clearances[row], expected[1], rtol=0, atol=1e-12)
    assert 0 < n_grasps < 20 * COUNT
