"""Tests of the pairs of links that never collide, against sampled poses and links that do collide."""

import itertools
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.models.scene_spec import _NEVER_COLLIDING, SceneModelBuilder

CONFIG = PhysicsConfig()


def assets(robot: str) -> SceneAssets:
    return SyntheticDataset(robot=robot).load_scene(209).assets


def robot_model(panda: Path) -> mujoco.MjModel:
    builder = SceneModelBuilder(CONFIG)
    builder.add_robot(panda)
    return builder.spec.compile()


def closest(model: mujoco.MjModel, poses: int) -> dict[tuple[int, int], float]:
    """Return the smallest distance of each pair of the robot's bodies in sampled poses (m)."""
    data, rng = mujoco.MjData(model), np.random.default_rng(7)
    bodies = [body for body in range(1, model.nbody) if model.body_geomnum[body]]
    found = dict.fromkeys(itertools.combinations(bodies, 2), np.inf)
    low, high = model.jnt_range.T
    for _ in range(poses):
        data.qpos[:] = rng.uniform(low - 0.02, high + 0.02)
        mujoco.mj_kinematics(model, data)
        for one, other in found:
            gap = mujoco.mj_geomDistance(
                model, data, int(model.body_geomadr[one]), int(model.body_geomadr[other]), 1.0, None
            )
            found[one, other] = min(found[one, other], gap)
    return found


@pytest.mark.parametrize("robot", ["panda", "panda_camera"])
def test_excluded_pairs_stay_apart_in_sampled_poses(robot: str) -> None:
    model = robot_model(assets(robot).panda)
    assert (model.body_geomnum <= 1).all(), "what is measured here is one geom a body"
    gaps = {(model.body(one).name, model.body(other).name): gap for (one, other), gap in closest(model, 400).items()}
    scene = load_scene_model(assets(robot), CONFIG).model
    excluded = {(scene.body(sign >> 16).name, scene.body(sign & 0xFFFF).name) for sign in scene.exclude_signature}
    pairs = {pair for pair in _NEVER_COLLIDING if set(pair) <= {name for names in gaps for name in names}}
    assert len(pairs) == (12 if robot == "panda_camera" else 9)
    assert pairs < excluded
    assert min(gaps[pair] for pair in pairs) > 0.01
    # Some links do collide, so that a pair list of all links would fail.
    assert any(gap < 0.0 for gap in gaps.values())
