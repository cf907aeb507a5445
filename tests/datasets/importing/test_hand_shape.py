from dataclasses import replace

import numpy as np
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st

from tests.datasets.importing.raw_files import hand_model

BETAS = st.lists(st.floats(-3.0, 3.0), min_size=10, max_size=10)


@given(betas=BETAS)
def test_shape_and_joints(betas: list[float]) -> None:
    model = hand_model()
    vertices = model.shaped_vertices(betas)
    np.testing.assert_allclose(vertices, model.v_template + model.shapedirs @ betas, atol=1e-12)
    joints = model.joints(vertices)
    np.testing.assert_allclose(joints, model.j_regressor @ vertices, atol=1e-12)
    np.testing.assert_array_equal(model.wrist(betas), joints[0])


def test_sums_go_from_left_to_right() -> None:
    model = hand_model()
    shapedirs = np.zeros_like(model.shapedirs)
    shapedirs[0, 0] = [1.0, 2.0**-53, 2.0**-53, 0, 0, 0, 0, 0, 0, 0]
    regressor = scipy.sparse.lil_matrix((16, 778))
    regressor[3, 5], regressor[3, 6], regressor[3, 7] = 1.0, 2.0**-53, 2.0**-53
    model = replace(model, shapedirs=shapedirs, j_regressor=regressor.tocsc(), v_template=np.zeros((778, 3)))
    # The other way round, the two small ones would together make a difference.
    assert model.shaped_vertices([1.0] * 10)[0, 0] == 1.0
    assert model.joints(np.ones((778, 3)))[3, 0] == 1.0


def test_mean_hand() -> None:
    model = hand_model()
    np.testing.assert_array_equal(model.shaped_vertices([0] * 10), model.v_template)
