"""What happens in the fingers when a person lets go."""

import math

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.sim.bullet.bullet_trial import BulletTrial

DATA = SyntheticDataset()
BRICK = "061_foam_brick"


@pytest.mark.parametrize("panda_urdf", [None, DATA.panda_urdf])
def test_a_good_grasp_keeps_the_object(panda_urdf: object) -> None:
    grasps = DATA.grasps(BRICK)
    assert grasps is not None
    trial = BulletTrial(DATA.object_urdf(BRICK), panda_urdf=panda_urdf)  # type: ignore[arg-type]
    slips = [trial.slip_on_release(grasp, 0.22, 0.06) for grasp in grasps[:8]]
    # Nothing is remembered from one grasp to the next.
    assert trial.slip_on_release(grasps[0], 0.22, 0.06) == slips[0]
    trial.close()
    assert np.median(slips) < 0.003


def test_fingers_that_close_on_nothing_hold_nothing() -> None:
    grasps = DATA.grasps(BRICK)
    assert grasps is not None
    away = grasps[0].copy()
    away[:3, 3] -= 0.2 * away[:3, 2]
    trial = BulletTrial(DATA.object_urdf(BRICK))
    assert trial.slip_on_release(away, 0.22, 0.06) == math.inf
    trial.close()
