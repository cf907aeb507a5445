"""Tests of scene models in MuJoCo, which have Bullet's masses, link poses, joint limits and collision masks."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.simulation.bullet.bodies import PandaBody
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf
from handover_marl.simulation.mujoco.grasp_validation import GripperModelBuilder
from handover_marl.simulation.mujoco.models import scene_model
from handover_marl.simulation.mujoco.models.collision_shapes import CollisionGroup
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model
from handover_marl.simulation.mujoco.models.scene_spec import ModelPadding

CONFIG = PhysicsConfig()
ASSETS = SyntheticDataset().load_scene(209).assets


@pytest.fixture(scope="module")
def client() -> BulletClient:
    return connect()


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return load_scene_model(ASSETS, CONFIG)


def test_cached_models_of_many_scenes_take_bounded_memory(scene: SceneModel) -> None:
    assert scene_model.CACHE_SIZE * mujoco.mj_sizeModel(scene.model) < 0.6e9


def test_all_jacobians_are_dense() -> None:
    """MuJoCo would choose sparse matrices from 60 degrees of freedom on."""
    many = replace(ASSETS, objects=ASSETS.objects * 9)
    scenes = [load_scene_model(assets, CONFIG) for assets in (ASSETS, many)]
    scenes.append(load_scene_model(ASSETS, CONFIG, padding=ModelPadding(objects=9, hulls=20)))
    gripper = GripperModelBuilder(ASSETS.objects[0], ASSETS.panda, CONFIG).spec.compile()
    models = [gripper, *(model for scene in scenes for model in (scene.model, scene.robot_only.model))]
    assert max(model.nv for model in models) > 60
    assert [mujoco.mj_isSparse(model) for model in models] == [0] * len(models)


@pytest.mark.parametrize("robot", ["synthetic", "real"])
def test_bodies_equal_bullets(client: BulletClient, robot: str, request: pytest.FixtureRequest) -> None:
    """Masses and inertias of robot and objects, and the robot's link poses at random joints, are Bullet's."""
    panda = ASSETS.panda
    if robot == "real":
        folder: Path = request.getfixturevalue("real_data")
        panda = folder / "assets" / "franka_panda" / "panda_gripper_hand_camera.urdf"
    scene, loaded = load_scene_model(replace(ASSETS, panda=panda), CONFIG), PandaBody(client, panda, CONFIG.panda)
    model, data = scene.model, mujoco.MjData(scene.model)
    bodies = [model.body(joint.link).id for joint in read_tree(panda).joints]
    objects = [load_urdf(client, urdf, useFixedBase=True) for urdf in ASSETS.objects]
    links = [(body, loaded.id, link) for link, body in enumerate(bodies)]
    links += [
        (body, own, client.getNumJoints(own) - 1) for body, own in zip(scene.objects.tolist(), objects, strict=True)
    ]
    for body, own, link in links:
        mass, _, inertia, center, *_ = client.getDynamicsInfo(own, link)
        assert model.body_mass[body] == pytest.approx(mass)
        np.testing.assert_allclose(model.body_ipos[body], center, atol=1e-12)
        np.testing.assert_allclose(np.sort(model.body_inertia[body]), np.sort(inertia), rtol=1e-5, atol=1e-12)
    rng = np.random.default_rng(3)
    for _ in range(5):
        joints = rng.uniform(LOWER_LIMITS, UPPER_LIMITS)
        loaded.reset_joints(joints.tolist())
        data.qpos[scene.robot_qpos] = joints
        mujoco.mj_kinematics(model, data)
        poses = loaded.read_link_poses(range(len(bodies))).astype(np.float64)
        np.testing.assert_allclose(data.xpos[bodies], poses[:, :3], atol=1e-6)
        turns = np.abs((np.roll(data.xquat[bodies], -1, axis=1) * poses[:, 3:]).sum(axis=1))
        np.testing.assert_allclose(turns, 1.0, atol=1e-6)


def test_collision_masks(scene: SceneModel) -> None:
    model = scene.model
    types, affinities = model.body_contype, model.body_conaffinity

    def meet(first: int, second: int) -> bool:
        return bool(types[first] & affinities[second] or types[second] & affinities[first])

    robot, table = model.body("panda_leftfinger").id, model.body("table").id
    target, other = scene.objects[:2].tolist()
    hand = np.flatnonzero((model.body_mocapid >= scene.hand.start) & (types == CollisionGroup.HAND)).tolist()
    assert len(hand) == len(scene.hand_links) == 16
    assert all(meet(robot, body) for body in (table, target, other, *hand, 0, robot))
    assert not any(meet(target, body) for body in (table, other, *hand, 0)), "a held object meets the robot only"
    assert not any(meet(hand[0], body) for body in (table, target, 0, hand[1]))
