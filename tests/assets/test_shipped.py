"""Tests of the shipped models and grasps: structure, sizes, kinematics and rebuilding."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handover_marl.assets.building.grasps import make_human_grasps
from handover_marl.assets.hand_model import (
    GRASPED_OBJECTS,
    GRASPS_FILE,
    LEVELS,
    SIDES,
    SUBJECT_SIZES,
    SUBJECTS,
    WRIST_DISTANCE_QUANTILES,
    Side,
    find_hand_urdf,
    load_human_grasps,
    make_hand_geometry,
)
from handover_marl.assets.shipped import (
    CAMERA_PANDA_URDF,
    CLASSES_WITHOUT_GRASPS,
    COLLISION_NAME,
    GRASPS_PATH,
    OBJECTS_ROOT,
    PANDA_URDF,
    VISUAL_NAME,
    find_object_urdf,
    load_object_grasps,
    load_shipped_arrays,
)
from handover_marl.config import HandConfig, PandaConfig
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.errors import DataFormatError, UnknownNameError
from handover_marl.geometry.model_files.obj_files import read_obj
from handover_marl.geometry.panda import CAMERA_LINK, HAND_LINK, LOWER_LIMITS, UPPER_LIMITS
from handover_marl.geometry.poses import compose, invert_pose
from handover_marl.geometry.rotations import rotate_points
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.bullet.bodies import HandBody, PandaBody
from handover_marl.simulation.bullet.client import BulletClient, connect, load_urdf

#: Lowest and highest corner (m) of the scanned object's bounding box in its frame, by YCB class
#: name; measured on the YCB-Video models (Calli et al., 2015; Xiang et al., 2018).
YCB_BOUNDS = {
    "002_master_chef_can": ((-0.0525, -0.0508, -0.0737), (0.0499, 0.0519, 0.0665)),
    "003_cracker_box": ((-0.0364, -0.0836, -0.1116), (0.0352, 0.0803, 0.1019)),
    "004_sugar_box": ((-0.0239, -0.0484, -0.0924), (0.0256, 0.0456, 0.0836)),
    "005_tomato_soup_can": ((-0.0341, -0.0323, -0.0593), (0.0336, 0.0354, 0.0426)),
    "006_mustard_bottle": ((-0.0499, -0.0357, -0.0839), (0.0473, 0.0308, 0.1075)),
    "007_tuna_fish_can": ((-0.0428, -0.0429, -0.0208), (0.0428, 0.0424, 0.0127)),
    "008_pudding_box": ((-0.0703, -0.0604, -0.0224), (0.0676, 0.0682, 0.0163)),
    "009_gelatin_box": ((-0.0461, -0.0500, -0.0186), (0.0432, 0.0510, 0.0115)),
    "010_potted_meat_can": ((-0.0534, -0.0308, -0.0498), (0.0488, 0.0293, 0.0338)),
    "011_banana": ((-0.0358, -0.1014, -0.0169), (0.0732, 0.0769, 0.0198)),
    "019_pitcher_base": ((-0.0797, -0.0787, -0.1471), (0.0692, 0.0662, 0.0956)),
    "021_bleach_cleanser": ((-0.0562, -0.0314, -0.1120), (0.0461, 0.0363, 0.1385)),
    "024_bowl": ((-0.0803, -0.0815, -0.0245), (0.0808, 0.0795, 0.0306)),
    "025_mug": ((-0.0503, -0.0457, -0.0391), (0.0669, 0.0472, 0.0424)),
    "035_power_drill": ((-0.1010, -0.1146, -0.0265), (0.0833, 0.0726, 0.0308)),
    "036_wood_block": ((-0.0534, -0.0492, -0.1200), (0.0506, 0.0543, 0.0858)),
    "037_scissors": ((-0.0551, -0.0726, -0.0078), (0.0410, 0.1289, 0.0079)),
    "040_large_marker": ((-0.0105, -0.0583, -0.0098), (0.0105, 0.0625, 0.0092)),
    "051_large_clamp": ((-0.0705, -0.0834, -0.0191), (0.0497, 0.0875, 0.0199)),
    "052_extra_large_clamp": ((-0.1044, -0.0717, -0.0185), (0.1052, 0.0925, 0.0179)),
    "061_foam_brick": ((-0.0261, -0.0389, -0.0172), (0.0266, 0.0388, 0.0339)),
}
NAMES = tuple(CLASS_NAMES.values())


@pytest.mark.parametrize("name", NAMES)
def test_urdf_has_the_official_structure_and_the_size_of_the_scan(name: str) -> None:
    client = connect()
    body = client.loadURDF(str(find_object_urdf(name)), useFixedBase=True)
    infos = [client.getJointInfo(body, joint) for joint in range(client.getNumJoints(body))]
    assert [info[2] for info in infos] == [client.JOINT_PRISMATIC] * 3 + [client.JOINT_REVOLUTE] * 3
    assert [info[12].decode() for info in infos] == [f"link{number}" for number in range(1, 7)]
    assert [info[13] for info in infos] == [tuple(axis) for axis in np.eye(3).tolist() * 2]
    assert client.getDynamicsInfo(body, 5)[:2] == (0.5, 0.9)
    assert [len(client.getCollisionShapeData(body, link)) for link in range(-1, 5)] == [0] * 6
    assert len(client.getVisualShapeData(body)) == 1
    for file in (VISUAL_NAME, COLLISION_NAME):
        vertices = read_obj(OBJECTS_ROOT / name / file).vertices
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
        np.testing.assert_allclose(bounds, YCB_BOUNDS[name], rtol=0, atol=0.003)


SOLID_LINKS = [6, *range(9, 52, 3)]


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("subject", SUBJECTS)
def test_every_hand_has_the_official_structure_and_the_kinematics_of_its_model(subject: int, side: Side) -> None:
    client, rng = connect(), np.random.default_rng(subject)
    dof = np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-1.5, 1.5, 48)])
    hand = HandBody(client, find_hand_urdf(subject, side), list(dof), HandConfig())
    assert (hand.n_links, len(hand.joints), hand.get_link("link7")) == (52, 51, 6)
    types = [client.getJointInfo(hand.id, joint)[2] for joint in range(52)]
    expected = [client.JOINT_PRISMATIC] * 3 + [client.JOINT_REVOLUTE] * 3 + [client.JOINT_FIXED]
    assert types == expected + [client.JOINT_REVOLUTE] * 45
    limits = np.array([client.getJointInfo(hand.id, joint)[8:10] for joint in range(7, 52)])
    np.testing.assert_allclose(limits, np.tile(np.outer([np.pi, np.pi / 2, np.pi], [-1, 1]), (15, 1)))
    assert [client.getDynamicsInfo(hand.id, link)[0] for link in SOLID_LINKS] == [0.2] + [0.02] * 15
    model, poses = make_hand_geometry(subject, side), hand.read_link_poses(SOLID_LINKS)
    positions, rotations = model.compute_link_poses(dof)
    np.testing.assert_allclose(positions, poses[:, :3], atol=2e-6)
    for axis in np.eye(3):
        np.testing.assert_allclose(rotations @ axis, rotate_points(poses[:, 3:], np.tile(axis, (16, 1))), atol=2e-6)
    keypoints = model.compute_keypoints(dof)
    np.testing.assert_allclose(np.delete(keypoints, [4, 8, 12, 16, 20], axis=0), hand.read_keypoints(), atol=2e-6)
    keypoints = model.compute_keypoints(np.zeros(51))
    reach = np.linalg.norm(keypoints[8] - keypoints[0])
    assert reach == pytest.approx(SUBJECT_SIZES[subject - 1].length, abs=1e-3)


def joints(client: BulletClient, urdf: Path) -> dict[str, tuple[Any, ...]]:
    """Return PyBullet's data of each link's joint without the indices of the joint and its parent, by link name."""
    body = load_urdf(client, urdf, useFixedBase=True)
    infos = [client.getJointInfo(body, joint) for joint in range(client.getNumJoints(body))]
    return {info[12].decode(): (info[1], info[2], *info[6:16]) for info in infos}


@pytest.mark.slow
def test_joints_are_those_of_the_plain_panda() -> None:
    client = connect()
    plain, camera = joints(client, PANDA_URDF), joints(client, CAMERA_PANDA_URDF)
    assert camera.pop(CAMERA_LINK)[1] == client.JOINT_FIXED
    assert camera == plain
    assert list(camera) == list(plain), "moving joints keep their order"


def test_camera_pose_equals_handoversims() -> None:
    client, robot = connect(), np.random.default_rng(1).uniform(LOWER_LIMITS, UPPER_LIMITS)
    panda, plain = (PandaBody(client, urdf, PandaConfig()) for urdf in (CAMERA_PANDA_URDF, PANDA_URDF))
    panda.reset_joints(robot.tolist())
    hand, camera = panda.read_link_poses([panda.get_link(HAND_LINK), panda.get_link(CAMERA_LINK)]).astype(np.float64)
    relative = compose(invert_pose(hand), camera)
    np.testing.assert_allclose(relative[:3], [0.036, 0.0, 0.036], atol=1e-6)
    assert abs(relative[3:] @ [-0.5, 0.5, -0.5, 0.5]) == pytest.approx(1.0, abs=1e-6)
    # A Panda without a camera has the same camera pose.
    plain.reset_joints(robot.tolist())
    for pose in (panda.read_camera_pose(), plain.read_camera_pose()):
        np.testing.assert_allclose(pose[:3], camera[:3], atol=1e-6)
        assert abs(pose[3:] @ camera[3:]) == pytest.approx(1.0, abs=1e-6)


GRASPABLE = tuple(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
# Bullet adds a margin of about a millimeter to both shapes of a pair.
MOST_OVERLAP, MARGINS = 0.008, 0.002
DIGIT_LINKS = [range(7 + 9 * digit, 16 + 9 * digit) for digit in range(5)]


@pytest.mark.parametrize("name", GRASPABLE)
def test_object_lies_between_the_open_fingers(name: str) -> None:
    solid = read_solid(find_object_urdf(name))
    across = np.linspace(-0.04, 0.04, 31)  # between the open fingers, along the gripper frame's x
    depths = np.linspace(0.084, 0.111, 6)  # along the finger pads
    local = np.stack([*np.meshgrid(across, [0.0], depths, indexing="ij"), np.ones((31, 1, 6))], axis=-1).reshape(-1, 4)
    grasps = load_object_grasps(name)
    assert grasps is not None
    points = (local @ grasps.swapaxes(1, 2))[..., :3]
    outside = (solid.compute_distances(points) > 0.0).reshape(-1, 31, 6)
    assert outside[:, [0, -1]].all()  # where the fingers are
    assert not outside.all(axis=(1, 2)).any()  # between their pads


def test_classes_without_grasps_and_bad_names_and_files(tmp_path: Path) -> None:
    assert all(load_object_grasps(name) is None for name in CLASSES_WITHOUT_GRASPS)
    with np.load(GRASPS_PATH, allow_pickle=False) as archive:
        assert sorted(archive.files) == sorted(GRASPABLE)
    with pytest.raises(UnknownNameError, match="025_cup"):
        load_object_grasps("025_cup")
    (tmp_path / "damaged.npz").write_bytes(b"PK no archive")
    with pytest.raises(DataFormatError, match="damaged"):
        load_shipped_arrays(tmp_path / "damaged.npz")


@pytest.mark.parametrize("name", GRASPED_OBJECTS)
def test_human_grasps_have_thumb_and_two_fingers_and_dexycbs_distances(name: str) -> None:
    grasps = [load_human_grasps(name, subject, side) for subject, side in itertools.product(SUBJECTS, SIDES)]
    for one in grasps:
        assert len(one) >= 12
        assert one.touching[:, 4].all()
        assert (one.touching[:, :4].sum(axis=1) >= 2).all()
    levels = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
    recorded = np.interp(levels, LEVELS, WRIST_DISTANCE_QUANTILES[name])
    ours = np.quantile(np.concatenate([one.wrist_distance for one in grasps]), levels)
    np.testing.assert_allclose(ours, recorded, atol=0.012)


@pytest.mark.slow
@pytest.mark.parametrize("name", GRASPED_OBJECTS)
@pytest.mark.parametrize("side", SIDES)
def test_human_grasps_hold_in_the_simulator(name: str, side: Side) -> None:
    rng, client = np.random.default_rng(GRASPED_OBJECTS.index(name)), connect()
    subject = int(rng.choice(SUBJECTS))
    grasps = load_human_grasps(name, subject, side)
    item = load_urdf(client, find_object_urdf(name), useFixedBase=True)
    dof = grasps.compute_hand_dof()[int(rng.integers(len(grasps)))]
    hand = HandBody(client, find_hand_urdf(subject, side), list(dof), HandConfig())
    client.performCollisionDetection()
    gaps: dict[int, float] = {}
    for point in client.getClosestPoints(hand.id, item, 0.01):
        gaps[point[3]] = min(gaps.get(point[3], np.inf), point[8])
    assert min(gaps.values()) > -(MOST_OVERLAP + MARGINS)
    near = [min(gaps.get(link, np.inf) for link in links) < 0.003 for links in DIGIT_LINKS]
    assert near[4]
    assert sum(near[:4]) >= 2


def test_built_human_grasps_are_like_the_shipped_ones() -> None:
    name = "009_gelatin_box"
    built = make_human_grasps(name, read_solid(find_object_urdf(name)), SUBJECT_SIZES[0], "left", 0)
    with np.load(GRASPS_FILE, allow_pickle=False) as archive:
        assert all(archive[key].dtype == values.dtype for key, values in built.items())
    shipped = load_human_grasps(name, 1, "left")
    np.testing.assert_allclose(np.sort(built["wrist_distance"]), shipped.wrist_distance, atol=0.01)
    assert built["touching"][:, 4].all()
