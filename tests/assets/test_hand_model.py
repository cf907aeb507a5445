import numpy as np
import pytest

from handover_marl.assets.anthropometry import SUBJECT_SIZES
from handover_marl.assets.hand_model import (
    HANDS_FOLDER,
    SIDES,
    SUBJECTS,
    find_hand_urdf,
    format_hand_name,
    make_hand_geometry,
)
from handover_marl.config import HandConfig
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


@pytest.mark.slow
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
def test_hand_lengths_are_those_of_the_table(subject):
    keypoints = make_hand_geometry(subject, "right").compute_keypoints(np.zeros(51))
    reach = np.linalg.norm(keypoints[8] - keypoints[0])
    assert reach == pytest.approx(SUBJECT_SIZES[subject - 1].length, abs=1e-3)


@pytest.mark.slow
def test_rebuild_gives_the_shipped_hands(tmp_path):
    pytest.importorskip("trimesh")
    pytest.importorskip("manifold3d")
    from handover_marl.assets.building.hands import write_hand_urdf, write_meshes

    write_meshes(tmp_path, "left")
    path = write_hand_urdf(tmp_path, 3, "left")
    assert path == tmp_path / format_hand_name(3, "left") / "mano.urdf"
    written = [file.relative_to(tmp_path) for file in tmp_path.rglob("*") if file.is_file()]
    assert len(written) == 33
    for file in written:
        assert (HANDS_FOLDER / file).read_bytes() == (tmp_path / file).read_bytes(), file
