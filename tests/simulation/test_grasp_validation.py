"""Tests of grasp validation with a gripper that has no arm, in both engines."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.execution import options
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.simulation import engines as module
from handover_marl.simulation.bullet.grasp_validation import BulletGraspValidator
from handover_marl.simulation.engines import make_grasp_validator, select_validation_engine
from handover_marl.simulation.grasp_validation import GraspValidationConfig, GraspValidator

DATA, CAMERA_DATA = SyntheticDataset(), SyntheticDataset(PANDA_CAMERA)
BOX, BRICK, MARKER = "003_cracker_box", "061_foam_brick", "040_large_marker"


@pytest.fixture(params=["bullet", "mujoco"])
def engine(request: pytest.FixtureRequest) -> str:
    if request.param == "mujoco":
        pytest.importorskip("mujoco")
    return str(request.param)


def make_validator(
    engine: str, name: str, config: GraspValidationConfig | None = None, panda: Path | None = None
) -> GraspValidator:
    given = DATA.find_object_urdf(name), config, panda or DATA.panda_urdf
    if engine == "bullet":
        return BulletGraspValidator(*given)
    from handover_marl.simulation.mujoco.grasp_validation import MujocoGraspValidator

    return MujocoGraspValidator(*given)


def grasps_of(name: str) -> np.ndarray:
    grasps = DATA.load_grasps(name)
    assert grasps is not None
    return grasps


@pytest.mark.parametrize("panda", [DATA.panda_urdf, CAMERA_DATA.panda_urdf])
def test_objects_stay_in_good_grasps(engine: str, panda: Path) -> None:
    validator, grasps = make_validator(engine, BRICK, panda=panda), grasps_of(BRICK)
    slips = [validator.measure_release_slip(grasp, 0.22, 0.06) for grasp in grasps[:8]]
    # Results do not depend on earlier grasps.
    assert validator.measure_release_slip(grasps[0], 0.22, 0.06) == slips[0]
    validator.close()
    assert np.median(slips) < 0.003


def test_empty_fingers_have_infinite_slip(engine: str) -> None:
    away = grasps_of(BRICK)[0].copy()
    away[:3, 3] -= 0.2 * away[:3, 2]
    validator = make_validator(engine, BRICK)
    assert validator.measure_release_slip(away, 0.22, 0.06) == math.inf
    validator.close()


def test_bad_grasps_are_rejected(engine: str) -> None:
    validator, grasp = make_validator(engine, BOX), grasps_of(BOX)[0]
    missed, deep, turned = grasp.copy(), grasp.copy(), grasp.copy()
    missed[:3, 3] -= 0.1 * grasp[:3, 2]
    deep[:3, 3] += 0.05 * grasp[:3, 2]
    turned[:3, :3] = grasp[:3, :3] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert validator.is_collision_free(missed)
    assert not validator.is_stable(missed)
    assert not validator.is_collision_free(deep)
    # A gripper rotated by 90 degrees does not fit over the box, so that a wrong frame convention is detected.
    assert not validator.is_collision_free(turned)


def test_slip_is_detected(engine: str) -> None:
    grasp, rough = grasps_of(MARKER)[0], replace(GraspValidationConfig(), acceleration=2_000.0)
    assert make_validator(engine, MARKER).is_stable(grasp)
    assert not make_validator(engine, MARKER, rough).is_stable(grasp)


def test_engines_agree() -> None:
    """Both engines agree in over 90 % of the checks of good grasps and of grasps that are displaced and often bad."""
    pytest.importorskip("mujoco")
    rng, quick = np.random.default_rng(0), GraspValidationConfig(close_time=0.25, shake_time=0.06)
    found = []
    for name in (BOX, MARKER, "025_mug"):
        bullet, mujoco = (make_validator(engine, name, quick) for engine in ("bullet", "mujoco"))
        for grasp in grasps_of(name)[::8][:6]:
            moved = grasp.copy()
            moved[:3, 3] += grasp[:3, :3] @ rng.uniform([-0.03, -0.03, -0.05], [0.03, 0.03, 0.02])
            for one in (grasp, moved):
                found.append((bullet.is_collision_free(one), mujoco.is_collision_free(one)))
                found.append((bullet.is_stable(one), mujoco.is_stable(one)))
    bullets, mujocos = np.array(found).T
    assert 0.2 < bullets.mean() < 0.95
    assert (bullets == mujocos).mean() > 0.9


def test_the_installed_engine_validates(monkeypatch: pytest.MonkeyPatch) -> None:
    assert select_validation_engine() == "bullet"
    assert isinstance(make_grasp_validator(DATA.find_object_urdf(BRICK)), BulletGraspValidator)
    pytest.importorskip("mujoco")
    monkeypatch.setattr(module, "is_pybullet_installed", lambda: False)
    assert options.is_pybullet_installed()
    assert select_validation_engine() == "mujoco"
    assert type(make_grasp_validator(DATA.find_object_urdf(BRICK))).__name__ == "MujocoGraspValidator"
