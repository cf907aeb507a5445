"""Tests of scene models in MuJoCo, which have Bullet's masses, link poses, joint limits and collision masks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco

from handover_marl.config import PANDA_DOF, PandaConfig, PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import HandoverError, SimulationError
from handover_marl.geometry.kinematic_tree import read_tree
from handover_marl.geometry.model_files.urdf import read_urdf_links
from handover_marl.geometry.panda import LOWER_LIMITS, UPPER_LIMITS
from handover_marl.simulation.bullet.bodies import PandaBody
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf
from handover_marl.simulation.mujoco.grasp_validation import GripperModelBuilder
from handover_marl.simulation.mujoco.models.collision_shapes import CollisionGroup, load_link_parts
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model
from handover_marl.simulation.mujoco.models.scene_spec import ModelPadding
from tests.geometry.test_unreadable_models import write_model
from tests.unreadable import UNREADABLE, refuses_within, replace_by

CONFIG = PhysicsConfig()
ASSETS = SyntheticDataset().load_scene(209).assets
RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def client() -> BulletClient:
    return connect()


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return load_scene_model(ASSETS, CONFIG)


def bodies_of(scene: SceneModel, urdf: Path) -> list[int]:
    return [scene.model.body(joint.link).id for joint in read_tree(urdf).joints]


def test_all_jacobians_are_dense() -> None:
    """MuJoCo would choose sparse matrices from 60 degrees of freedom on."""
    many = replace(ASSETS, objects=ASSETS.objects * 9)
    scenes = [load_scene_model(assets, CONFIG) for assets in (ASSETS, many)]
    scenes.append(load_scene_model(ASSETS, CONFIG, padding=ModelPadding(objects=9, hulls=20)))
    gripper = GripperModelBuilder(ASSETS.objects[0], ASSETS.panda, CONFIG).spec.compile()
    models = [gripper, *(model for scene in scenes for model in (scene.model, scene.robot_only.model))]
    assert max(model.nv for model in models) > 60
    assert [mujoco.mj_isSparse(model) for model in models] == [0] * len(models)


def test_masses_and_inertias_equal_bullets(client: BulletClient, scene: SceneModel) -> None:
    panda = PandaBody(client, ASSETS.panda, CONFIG.panda)
    for link, body in enumerate(bodies_of(scene, ASSETS.panda)):
        info = client.getDynamicsInfo(panda.id, link)
        assert scene.model.body_mass[body] == pytest.approx(info[0])
        np.testing.assert_allclose(scene.model.body_ipos[body], info[3], atol=1e-12)
        np.testing.assert_allclose(np.sort(scene.model.body_inertia[body]), np.sort(info[2]), rtol=1e-5, atol=1e-12)
    for body, urdf in zip(scene.objects, ASSETS.objects, strict=True):
        found = load_urdf(client, urdf, useFixedBase=True)
        info = client.getDynamicsInfo(found, client.getNumJoints(found) - 1)
        assert scene.model.body_mass[body] == pytest.approx(info[0])
        np.testing.assert_allclose(np.sort(scene.model.body_inertia[body]), np.sort(info[2]), rtol=1e-5)


def test_link_poses_equal_bullets(client: BulletClient, scene: SceneModel) -> None:
    panda = PandaBody(client, ASSETS.panda, CONFIG.panda)
    data = mujoco.MjData(scene.model)
    bodies = bodies_of(scene, ASSETS.panda)
    for _ in range(5):
        joints = RNG.uniform(LOWER_LIMITS, UPPER_LIMITS)
        panda.reset_joints(joints.tolist())
        data.qpos[scene.robot_qpos] = joints
        mujoco.mj_kinematics(scene.model, data)
        poses = panda.read_link_poses(range(len(bodies))).astype(np.float64)
        np.testing.assert_allclose(data.xpos[bodies], poses[:, :3], atol=1e-6)
        turns = np.abs((np.roll(data.xquat[bodies], -1, axis=1) * poses[:, 3:]).sum(axis=1))
        np.testing.assert_allclose(turns, 1.0, atol=1e-6)


def test_joint_limits_equal_the_urdfs(scene: SceneModel) -> None:
    limits = [link.limits for link in read_urdf_links(ASSETS.panda, read_tree(ASSETS.panda))[:-1]]
    moving = np.array([limit for limit in limits if limit is not None])
    assert len(moving) == PANDA_DOF
    np.testing.assert_allclose(scene.model.jnt_range[:PANDA_DOF], moving)
    assert scene.model.jnt_limited[:PANDA_DOF].all()
    assert not scene.model.jnt_limited[PANDA_DOF:].any(), "objects have no limits"


def meet(model: "mujoco.MjModel", first: int, second: int) -> bool:
    """Return whether the masks of two bodies let them collide."""
    types, affinities = model.body_contype, model.body_conaffinity
    return bool(types[first] & affinities[second] or types[second] & affinities[first])


def test_collision_masks(scene: SceneModel) -> None:
    model = scene.model
    robot, table = model.body("panda_leftfinger").id, model.body("table").id
    target, other = scene.objects[:2].tolist()
    hand = [body for body in range(model.nbody) if model.body_mocapid[body] >= scene.hand.start]
    hand = [body for body in hand if model.body_contype[body] == CollisionGroup.HAND]
    assert len(hand) == len(scene.hand_links) == 16
    for body in (table, target, other, *hand, 0, robot):
        assert meet(model, robot, body)
    for body in (table, other, *hand, 0):
        assert not meet(model, target, body), "a held object collides with the robot only"
    for body in (table, target, 0, hand[1]):
        assert not meet(model, hand[0], body)


def test_both_pandas(client: BulletClient, real_data: Path) -> None:
    folder = real_data / "assets"
    for name in ("panda_gripper.urdf", "panda_gripper_hand_camera.urdf"):
        urdf = folder / "franka_panda" / name
        assets = SceneAssets(ASSETS.table, urdf, ASSETS.objects, ASSETS.hand)
        scene = load_scene_model(assets, CONFIG)
        panda = PandaBody(client, urdf, PandaConfig())
        for link, body in enumerate(bodies_of(scene, urdf)):
            info = client.getDynamicsInfo(panda.id, link)
            assert scene.model.body_mass[body] == pytest.approx(info[0])
            np.testing.assert_allclose(np.sort(scene.model.body_inertia[body]), np.sort(info[2]), rtol=1e-5, atol=1e-12)


def test_models_that_cannot_be_read(tmp_path: Path) -> None:
    broken = tmp_path / "object.urdf"
    assets = SceneAssets(ASSETS.table, ASSETS.panda, (broken,), ASSETS.hand)
    with pytest.raises(SimulationError, match=r"object\.urdf"):
        load_scene_model(assets, CONFIG)
    broken.write_text("<robot/>")
    with pytest.raises(SimulationError, match=r"object\.urdf"):
        load_scene_model(assets, CONFIG)


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("file", ["body.urdf", "body.obj", "body.stl"])
def test_unreadable_files_of_a_model(file: str, kind: str, tmp_path: Path) -> None:
    urdf = write_model(tmp_path, "body.stl" if file == "body.stl" else "body.obj")
    tree = read_tree(urdf)
    replace_by(kind, tmp_path / file)
    with refuses_within(5.0, HandoverError, kind):
        load_link_parts(urdf, tree)
