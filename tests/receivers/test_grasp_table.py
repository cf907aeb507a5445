"""Tests of the table of grasps, on NumPy arrays and on PyTorch tensors."""

import numpy as np

from handover_marl.geometry.arrays import NUMPY_ARRAYS, ArrayFactory, to_numpy
from handover_marl.receivers.grasp_library import GraspTable
from tests.tensors import make_device_tensors

#: Arrays of the grasps of three classes; class 4 has none.
KNOWN = {
    number: (np.full((count, 7), float(number)), np.full((count, 3), -float(number)))
    for number, count in ((2, 3), (7, 5), (9, 1))
}


def check_table(arrays: ArrayFactory) -> None:
    loaded = []

    def load(number: int) -> tuple[np.ndarray, ...] | None:
        loaded.append(number)
        return KNOWN.get(number)

    table = GraspTable(load, arrays)
    for classes, expected in (([4.0, 4.0], [-1, -1]), ([2.0, 4.0], [0, -1]), ([9.0, 7.0, 2.0], [2, 1, 0])):
        found = table.find(arrays.asarray(classes, "float32"))
        assert type(found) is type(table.is_grasp)
        assert found.tolist() == expected
    assert loaded == [4, 2, 7, 9]
    is_grasp = to_numpy(table.is_grasp)
    assert is_grasp.tolist() == [[True] * count + [False] * (5 - count) for count in (3, 5, 1)]
    for place, array in enumerate(map(to_numpy, table.arrays)):
        assert array.shape == (3, 5, (7, 3)[place])
        for row, number in enumerate((2, 7, 9)):
            np.testing.assert_array_equal(array[row, is_grasp[row]], KNOWN[number][place])
        assert not array[~is_grasp].any()


def test_tables_grow_with_the_classes() -> None:
    check_table(NUMPY_ARRAYS)
    with make_device_tensors() as arrays:
        check_table(arrays)
