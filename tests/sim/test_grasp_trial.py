"""What the hand alone finds out about grasps, in either engine."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl import options
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.models.panda import PANDA_CAMERA
from handover_marl.sim import grasp_trial as module
from handover_marl.sim.bullet.bullet_trial import BulletTrial
from handover_marl.sim.grasp_trial import GraspTrial, TrialConfig, grasp_trial, trial_engine

DATA, CAMERA_DATA = SyntheticDataset(), SyntheticDataset(PANDA_CAMERA)
BOX, BRICK, MARKER = "003_cracker_box", "061_foam_brick", "040_large_marker"


@pytest.fixture(params=["bullet", "mujoco"])
def engine(request: pytest.FixtureRequest) -> str:
    if request.param == "mujoco":
        pytest.importorskip("mujoco")
    return str(request.param)


def make_trial(engine: str, name: str, config: TrialConfig | None = None, panda: Path | None = None) -> GraspTrial:
    given = DATA.object_urdf(name), config, panda or DATA.panda_urdf
    if engine == "bullet":
        return BulletTrial(*given)
    from handover_marl.sim.mujoco.mujoco_trial import MujocoTrial

    return MujocoTrial(*given)


def grasps_of(name: str) -> np.ndarray:
    grasps = DATA.grasps(name)
    assert grasps is not None
    return grasps


@pytest.mark.parametrize("panda", [DATA.panda_urdf, CAMERA_DATA.panda_urdf])
def test_a_good_grasp_keeps_the_object(engine: str, panda: Path) -> None:
    trial, grasps = make_trial(engine, BRICK, panda=panda), grasps_of(BRICK)
    slips = [trial.slip_on_release(grasp, 0.22, 0.06) for grasp in grasps[:8]]
    # Nothing is remembered from one grasp to the next.
    assert trial.slip_on_release(grasps[0], 0.22, 0.06) == slips[0]
    trial.close()
    assert np.median(slips) < 0.003


def test_fingers_that_close_on_nothing_hold_nothing(engine: str) -> None:
    away = grasps_of(BRICK)[0].copy()
    away[:3, 3] -= 0.2 * away[:3, 2]
    trial = make_trial(engine, BRICK)
    assert trial.slip_on_release(away, 0.22, 0.06) == math.inf
    trial.close()


def test_bad_grasps_are_refused(engine: str) -> None:
    trial, grasp = make_trial(engine, BOX), grasps_of(BOX)[0]
    missed, deep, turned = grasp.copy(), grasp.copy(), grasp.copy()
    missed[:3, 3] -= 0.1 * grasp[:3, 2]
    deep[:3, 3] += 0.05 * grasp[:3, 2]
    turned[:3, :3] = grasp[:3, :3] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert trial.is_free(missed)
    assert not trial.holds(missed)
    assert not trial.is_free(deep)
    # The convention matters: a hand turned by 90 degrees does not fit over the box.
    assert not trial.is_free(turned)


def test_what_slips_is_noticed(engine: str) -> None:
    grasp, rough = grasps_of(MARKER)[0], replace(TrialConfig(), acceleration=2_000.0)
    assert make_trial(engine, MARKER).holds(grasp)
    assert not make_trial(engine, MARKER, rough).holds(grasp)


def test_engines_agree() -> None:
    """About good grasps, and about ones that were moved until half of them are bad."""
    pytest.importorskip("mujoco")
    rng, quick = np.random.default_rng(0), TrialConfig(close_time=0.25, shake_time=0.06)
    found = []
    for name in (BOX, MARKER, "025_mug"):
        bullet, mujoco = (make_trial(engine, name, quick) for engine in ("bullet", "mujoco"))
        for grasp in grasps_of(name)[::8][:6]:
            moved = grasp.copy()
            moved[:3, 3] += grasp[:3, :3] @ rng.uniform([-0.03, -0.03, -0.05], [0.03, 0.03, 0.02])
            for one in (grasp, moved):
                found.append((bullet.is_free(one), mujoco.is_free(one)))
                found.append((bullet.holds(one), mujoco.holds(one)))
    bullets, mujocos = np.array(found).T
    assert 0.2 < bullets.mean() < 0.95
    assert (bullets == mujocos).mean() > 0.9


def test_the_engine_that_is_installed_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    assert trial_engine() == "bullet"
    assert isinstance(grasp_trial(DATA.object_urdf(BRICK)), BulletTrial)
    pytest.importorskip("mujoco")
    monkeypatch.setattr(module, "pybullet_installed", lambda: False)
    assert options.pybullet_installed()
    assert trial_engine() == "mujoco"
    assert type(grasp_trial(DATA.object_urdf(BRICK))).__name__ == "MujocoTrial"
