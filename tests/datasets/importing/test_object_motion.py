import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from handover_marl.datasets.importing.object_motion import object_trajectory
from handover_marl.datasets.importing.tag_frame import TagFrame
from handover_marl.datasets.importing.upsampling import STRIDE
from tests.datasets.importing.raw_files import object_poses, tag_pose


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_key_poses_in_the_tag_frame(seed: int) -> None:
    poses, pose = object_poses(6, seed=seed)[:, 0], tag_pose(seed)
    found = object_trajectory(poses, TagFrame.from_extrinsics(pose))
    assert found.shape == (201, 6)
    assert found.dtype == np.float32
    keys = found[::STRIDE].astype(np.float64)
    np.testing.assert_allclose(keys[:, :3], (poses[:, 4:] - pose[:, 3]) @ pose[:, :3], atol=1e-5)
    expected = Rotation.from_matrix(pose[:, :3]).inv() * Rotation.from_quat(poses[:, :4])
    assert (Rotation.from_euler("XYZ", keys[:, 3:]) * expected.inv()).magnitude().max() < 1e-5


def test_angles_go_on_beyond_half_a_turn() -> None:
    poses = object_poses(12)[:, 0]
    tag = TagFrame.from_extrinsics(np.eye(3, 4))
    poses[:, :4] = Rotation.from_rotvec(np.linspace(0.0, 7.0, 12)[:, None] * [0.0, 0.0, 1.0]).as_quat()
    found = object_trajectory(poses, tag)
    np.testing.assert_allclose(found[[0, -1], 5], [0.0, 7.0], atol=1e-5)
