import numpy as np

from handover_marl.receivers.vision.grasp_tracker import PointMap


def test_points_are_forgotten_after_a_while() -> None:
    point_map = PointMap(voxel_size=0.01, memory=1.0)
    here, there = np.zeros((1, 3)), np.full((1, 3), 0.5)
    point_map.update(0.0, here, forget=True)
    point_map.update(0.5, there, forget=True)
    assert len(point_map.points) == 2
    point_map.update(2.0, there, forget=False)
    assert len(point_map.points) == 2
    point_map.update(2.1, np.zeros((0, 3)), forget=True)
    assert len(point_map.points) == 2
    point_map.update(2.2, there, forget=True)
    np.testing.assert_array_equal(point_map.points, there)
