from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.anthropometry import SKIN_COLORS, SUBJECT_SIZES
from handover_marl.assets.hand_model import (
    HANDS_FOLDER,
    SIDES,
    SUBJECTS,
    euler_from_matrices,
    find_hand_urdf,
    format_hand_name,
    make_hand_geometry,
    matrices_from_euler,
)
from handover_marl.config import HandConfig
from handover_marl.errors import UnknownNameError
from handover_marl.geometry.poses import rotate_points
from handover_marl.simulation.bullet.bodies import HandBody
from handover_marl.simulation.bullet.client import connect

ALL_HANDS = [(subject, side) for subject in SUBJECTS for side in SIDES]
SOLID_LINKS = [6, *range(9, 52, 3)]


def load(subject, side, dof):
    client = connect()
    return client, HandBody(client, find_hand_urdf(subject, side), list(dof), HandConfig())


@pytest.mark.parametrize(("subject", "side"), ALL_HANDS)
def test_every_hand_has_the_official_structure(subject, side):
    client, hand = load(subject, side, np.zeros(51))
    assert hand.n_links == 52
    assert len(hand.joints) == 51
    assert hand.get_link("link7") == 6
    types = [client.getJointInfo(hand.id, joint)[2] for joint in range(52)]
    expected = [client.JOINT_PRISMATIC] * 3 + [client.JOINT_REVOLUTE] * 3 + [client.JOINT_FIXED]
    assert types == expected + [client.JOINT_REVOLUTE] * 45
    limits = np.array([client.getJointInfo(hand.id, joint)[8:10] for joint in range(7, 52)])
    np.testing.assert_allclose(limits, np.tile(np.outer([np.pi, np.pi / 2, np.pi], [-1, 1]), (15, 1)))
    masses = [client.getDynamicsInfo(hand.id, link)[0] for link in SOLID_LINKS]
    assert masses == [0.2] + [0.02] * 15


@pytest.mark.parametrize(("subject", "side"), ALL_HANDS)
def test_all_link_frames_are_parallel_at_zero(subject, side):
    _, hand = load(subject, side, np.zeros(51))
    quaternions = hand.read_link_poses(range(52))[:, 3:]
    np.testing.assert_allclose(np.abs(quaternions), np.tile([0, 0, 0, 1], (52, 1)), atol=1e-7)


@pytest.mark.parametrize(("subject", "side"), ALL_HANDS)
def test_forward_kinematics_equals_the_simulator(subject, side):
    rng = np.random.default_rng(subject)
    model = make_hand_geometry(subject, side)
    for _ in range(5):
        dof = np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-1.5, 1.5, 48)])
        _, hand = load(subject, side, dof)
        poses = hand.read_link_poses(SOLID_LINKS)
        positions, rotations = model.compute_link_poses(dof)
        np.testing.assert_allclose(positions, poses[:, :3], atol=2e-6)
        for axis in np.eye(3):
            np.testing.assert_allclose(rotations @ axis, rotate_points(poses[:, 3:], np.tile(axis, (16, 1))), atol=2e-6)
        keypoints = model.compute_keypoints(dof)
        np.testing.assert_allclose(np.delete(keypoints, [4, 8, 12, 16, 20], axis=0), hand.read_keypoints(), atol=2e-6)


@pytest.mark.parametrize("subject", SUBJECTS)
def test_left_hand_is_mirrored(subject):
    rng = np.random.default_rng(0)
    dof = rng.uniform(-1, 1, 51)
    mirrored = dof.copy()
    mirrored[0] *= -1
    mirrored[3:] *= np.tile([1, -1, -1], 16)
    right, left = (
        make_hand_geometry(subject, side).compute_keypoints(d) for side, d in (("right", dof), ("left", mirrored))
    )
    np.testing.assert_allclose(left, right * [-1, 1, 1], atol=1e-12)


def test_directions_of_the_zero_pose():
    wrist, *points = make_hand_geometry(6, "right").compute_keypoints(np.zeros(51))
    tips = np.array(points)[3::4] - wrist
    assert (tips[:4, 0] < -0.1).all()
    assert tips[4, 2] > 0.05
    # Bending about +z takes the fingertips to the palm's side, -y.
    bent = np.zeros(51)
    bent[6 + 2 : 6 + 36 : 9] = 1.0
    curled = make_hand_geometry(6, "right").compute_keypoints(bent)
    assert (curled[[4, 8, 12, 16], 1] < -0.04).all()


@pytest.mark.parametrize("subject", SUBJECTS)
def test_hand_lengths_are_those_of_the_table(subject):
    keypoints = make_hand_geometry(subject, "right").compute_keypoints(np.zeros(51))
    reach = np.linalg.norm(keypoints[8] - keypoints[0])
    assert reach == pytest.approx(SUBJECT_SIZES[subject - 1].length, abs=1e-3)


def test_sizes_spread_over_women_and_men():
    lengths = np.array([size.length for size in SUBJECT_SIZES])
    assert lengths.min() < 0.167
    assert lengths.max() > 0.208
    assert len(SKIN_COLORS) == len(SUBJECT_SIZES) == 10


def test_collision_meshes_are_small():
    files = sorted(HANDS_FOLDER.glob("meshes/*/collision/*.obj"))
    assert len(files) == 32
    for path in files:
        assert path.read_text().count("v ") <= 60


def test_rebuild_gives_the_shipped_hands(tmp_path):
    pytest.importorskip("trimesh")
    pytest.importorskip("manifold3d")
    from handover_marl.assets.building.build_hands import write_hand_urdf, write_meshes

    write_meshes(tmp_path, "left")
    path = write_hand_urdf(tmp_path, 3, "left")
    assert path == tmp_path / format_hand_name(3, "left") / "mano.urdf"
    written = [file.relative_to(tmp_path) for file in tmp_path.rglob("*") if file.is_file()]
    assert len(written) == 33
    for file in written:
        assert (HANDS_FOLDER / file).read_bytes() == (tmp_path / file).read_bytes(), file


def test_size_of_all_hands():
    sizes = [path.stat().st_size for path in Path(HANDS_FOLDER).rglob("*") if path.is_file()]
    assert sum(sizes) < 3_000_000


def test_euler_angles_invert_the_matrices():
    angles = np.random.default_rng(0).uniform(-1.5, 1.5, (100, 3))
    np.testing.assert_allclose(euler_from_matrices(matrices_from_euler(angles)), angles, atol=1e-9)


def test_unknown_hands_are_refused():
    with pytest.raises(UnknownNameError, match="subject"):
        find_hand_urdf(11, "left")
    with pytest.raises(UnknownNameError, match="side"):
        make_hand_geometry(1, "middle")
