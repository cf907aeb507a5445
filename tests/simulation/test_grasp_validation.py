"""Tests of grasp validation with a gripper that has no arm."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.simulation.grasp_validation_config import GraspValidationConfig
from handover_marl.simulation.mujoco.grasp_validation import GraspValidator

DATA, CAMERA_DATA = SyntheticDataset(), SyntheticDataset(PANDA_CAMERA)
BOX, BRICK, MARKER = "003_cracker_box", "061_foam_brick", "040_large_marker"


def load_grasps(name: str) -> np.ndarray:
    grasps = DATA.load_grasps(name)
    assert grasps is not None
    return grasps


@pytest.mark.parametrize("panda", [DATA.panda_urdf, CAMERA_DATA.panda_urdf])
def test_objects_slip_only_out_of_bad_grasps(panda: Path) -> None:
    validator, grasps = GraspValidator(DATA.find_object_urdf(BRICK), None, panda), load_grasps(BRICK)
    slips = [validator.measure_release_slip(grasp, 0.22, 0.06) for grasp in grasps[:8]]
    assert validator.measure_release_slip(grasps[0], 0.22, 0.06) == slips[0], "earlier grasps change nothing"
    assert np.median(slips) < 0.003
    away = grasps[0].copy()
    away[:3, 3] -= 0.2 * away[:3, 2]
    assert validator.measure_release_slip(away, 0.22, 0.06) == math.inf


def test_bad_grasps_are_rejected() -> None:
    validator, grasp = GraspValidator(DATA.find_object_urdf(BOX)), load_grasps(BOX)[0]
    missed, deep, turned = grasp.copy(), grasp.copy(), grasp.copy()
    missed[:3, 3] -= 0.1 * grasp[:3, 2]
    deep[:3, 3] += 0.05 * grasp[:3, 2]
    turned[:3, :3] = grasp[:3, :3] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert validator.is_collision_free(missed)
    assert not validator.is_stable(missed)
    assert not validator.is_collision_free(deep)
    # A gripper rotated by 90 degrees does not fit over the box, so that a wrong frame convention is detected.
    assert not validator.is_collision_free(turned)
    urdf, rough = DATA.find_object_urdf(MARKER), replace(GraspValidationConfig(), acceleration=2_000.0)
    assert GraspValidator(urdf).is_stable(load_grasps(MARKER)[0])
    assert not GraspValidator(urdf, rough).is_stable(load_grasps(MARKER)[0])


@pytest.mark.slow
def test_shipped_grasps_hold() -> None:
    """Most of the shipped grasps, which were validated in PyBullet, are stable; displaced ones are often bad."""
    rng, held, displaced = np.random.default_rng(0), [], []
    for name in (BOX, "024_bowl", "037_scissors"):
        validator = GraspValidator(DATA.find_object_urdf(name))
        for grasp in load_grasps(name)[::15]:
            moved = grasp.copy()
            moved[:3, 3] += grasp[:3, :3] @ rng.uniform([-0.03, -0.03, -0.05], [0.03, 0.03, 0.02])
            for results, one in ((held, grasp), (displaced, moved)):
                results.append(validator.is_collision_free(one) and validator.is_stable(one))
    assert np.mean(held) > 0.85
    assert np.mean(displaced) < 0.7
