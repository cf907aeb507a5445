import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.importing.tag_frame import TagFrame, quaternions_from_matrices
from tests.datasets.importing.raw_files import random_rotations, tag_pose

SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS)
def test_points_go_to_the_tag_and_back(seed: int) -> None:
    pose = tag_pose(seed)
    points = np.random.default_rng(seed).normal(size=(7, 3))
    world = points @ pose[:, :3].T + pose[:, 3]
    found = TagFrame.from_extrinsics(pose).points(world.astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, points, atol=3e-6)


@given(seed=SEEDS)
def test_rotations_in_the_tag_frame(seed: int) -> None:
    pose, world = tag_pose(seed), random_rotations(5, seed)
    found = TagFrame.from_extrinsics(pose).quaternions(world)
    assert found.dtype == np.float32
    expected = Rotation.from_matrix(pose[:, :3]).inv() * world
    assert (Rotation.from_quat(found) * expected.inv()).magnitude().max() < 1e-6


def test_the_tag_itself_is_the_origin() -> None:
    pose = tag_pose(3)
    tag = TagFrame.from_extrinsics(pose)
    np.testing.assert_allclose(tag.points(pose[None, :, 3].astype(np.float32)), 0.0, atol=1e-6)
    found = np.abs(tag.quaternions(Rotation.from_matrix(pose[None, :, :3])))
    np.testing.assert_allclose(found, [[0.0, 0.0, 0.0, 1.0]], atol=1e-6)


@given(seed=SEEDS)
def test_matrices_are_not_orthogonalised(seed: int) -> None:
    rotation = random_rotations(20, seed)
    exact = quaternions_from_matrices(rotation.as_matrix())
    assert (np.abs(np.sum(exact * rotation.as_quat(), axis=1)) > 1.0 - 1e-12).all()
    # Stretched by a hundredth: the largest entry's row is taken as it stands.
    x, y, z, w = quaternions_from_matrices(np.diag([1.01, 1.0, 1.0])[None])[0]
    assert (x, y, z, w) == (0.0, 0.0, 0.0, 1.0)


def test_all_four_entries_can_be_the_largest() -> None:
    quaternions = np.concatenate([np.eye(4), 0.9 * np.eye(4) + 0.1])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    found = quaternions_from_matrices(Rotation.from_quat(quaternions).as_matrix())
    np.testing.assert_allclose(found, quaternions, atol=1e-15)
