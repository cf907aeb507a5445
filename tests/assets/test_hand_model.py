from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.hand_model import (
    HANDS_FOLDER,
    MESH_NAMES,
    SIDES,
    SUBJECT_SIZES,
    SUBJECTS,
    Side,
    find_hand_urdf,
    make_hand_geometry,
)
from handover_marl.config import HandConfig
from handover_marl.geometry.poses import rotate_points
from handover_marl.simulation.bullet.bodies import HandBody
from handover_marl.simulation.bullet.client import connect

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


def test_rebuild_gives_the_shipped_hands(tmp_path: Path) -> None:
    """The meshes of a left hand and its model are equal; only the visible palm takes too long to build here."""
    pytest.importorskip("trimesh")
    pytest.importorskip("manifold3d")
    from handover_marl.assets.building import hands

    path = hands.write_hand_urdf(tmp_path, 3, "left")
    assert path.read_bytes() == find_hand_urdf(3, "left").read_bytes()
    folder = HANDS_FOLDER / "meshes" / "left"
    for link, name in enumerate(MESH_NAMES):
        built = {"collision": hands.make_collision_mesh(link)}
        built |= {"visual": hands.make_visual_mesh(link)} if link else {}
        for kind, mesh in built.items():
            assert (folder / kind / f"{name}.obj").read_text() == hands.format_obj(mesh, mirror=True), (kind, name)
