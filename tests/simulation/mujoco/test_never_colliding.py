"""Tests of the proof that two links never collide, against sampled poses and links that do collide."""

import itertools
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.simulation.mujoco.distances import find_never_colliding_pairs
from handover_marl.simulation.mujoco.models.scene_model import load_scene_model
from handover_marl.simulation.mujoco.models.scene_spec import TUNING, SceneModelBuilder

CONFIG = PhysicsConfig()
ASSETS = SyntheticDataset().load_scene(209).assets


def robot_model(panda: Path) -> mujoco.MjModel:
    builder = SceneModelBuilder(CONFIG, TUNING)
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


def test_sampled_poses_agree() -> None:
    model = robot_model(ASSETS.panda)
    assert (model.body_geomnum <= 1).all(), "what is measured here is one geom a body"
    gaps, pairs = closest(model, 400), find_never_colliding_pairs(model)
    assert min(gaps[pair] for pair in pairs) > 0.01
    names = {(model.body(one).name, model.body(other).name) for one, other in pairs}
    assert {("panda_link1", "panda_link3"), ("panda_link2", "panda_link4"), ("panda_link6", "panda_hand")} <= names
    # Some links do collide, so that a pair list of all links would fail.
    assert any(gap < 0.0 for gap in gaps.values())
    assert ("panda_leftfinger", "panda_rightfinger") not in names


def two_links(limits: tuple[float, float], length: float) -> mujoco.MjModel:
    """Return a rod that rotates about the far end of an arm towards a sphere at the arm's root."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    root = spec.worldbody.add_body(name="root")
    root.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0.0, 0.0])
    arm = root.add_body(name="arm")
    arm.add_joint(axis=[1.0, 0.0, 0.0], limited=True, range=[-3.0, 3.0])
    arm.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0.0, 0.0], pos=[0.2, 0.0, 0.0])
    rod = arm.add_body(name="rod", pos=[0.4, 0.0, 0.0])
    rod.add_joint(axis=[0.0, 0.0, 1.0], limited=True, range=limits)
    rod.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[0.01, length / 2.0, 0.0],
        pos=[length / 2.0, 0.0, 0.0],
        quat=[1, 0, 1, 0],
    )
    return spec.compile()


@pytest.mark.parametrize(
    ("limits", "length", "apart"),
    [((-3.2, 3.2), 0.25, True), ((-3.2, 3.2), 0.45, False), ((-1.0, 1.0), 0.45, True), ((2.9, 3.1), 0.345, False)],
)
def test_proofs_on_a_rod(limits: tuple[float, float], length: float, apart: bool) -> None:
    model = two_links(limits, length)
    assert ((model.body("root").id, model.body("rod").id) in find_never_colliding_pairs(model)) == apart


def test_scene_models_exclude_the_pairs() -> None:
    scene = load_scene_model(ASSETS, CONFIG).model
    alone = robot_model(ASSETS.panda)
    named = {(alone.body(one).name, alone.body(other).name) for one, other in find_never_colliding_pairs(alone)}
    left_out = {
        (scene.body(sign >> 16).name, scene.body(sign & 0xFFFF).name) for sign in scene.exclude_signature.tolist()
    }
    assert named < left_out
