"""Tests of grasp validation, its cache, and the shipped records."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handover_marl.datasets import open_dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.geometry.poses import compose
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.grasps import validation as validation_module
from handover_marl.grasps.known_grasps import load_hand_poses
from handover_marl.grasps.validation import (
    GraspPreparationConfig,
    get_validation_record,
    get_validation_record_path,
    grasps_from_record,
    tilt_grasps,
    validate_grasps,
)
from tests.receivers.quick import QUICK_PREPARATION

DATA = SyntheticDataset()
URDF = DATA.find_object_urdf("061_foam_brick")
KNOWN = load_hand_poses(DATA.load_grasps, "061_foam_brick")
assert KNOWN is not None


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_grasps_from_record() -> None:
    config, known = GraspPreparationConfig(), KNOWN[:2]
    rows = [(-1, 3, 1, 4), (-1, 0, 0, 2), (1, 2, 4, 1), (5, 1, 2, 0)]
    grasps = grasps_from_record(np.array(rows, dtype=np.int16), known, config)
    bare = np.concatenate([known, tilt_grasps(known, config)[[1, 5]]])
    for number, (_, n_stable, advance, n_kept) in enumerate(rows):
        distance = config.advances[advance - 1] if advance else 0.0
        along = compose(bare[number], np.array([0.0, 0.0, distance, 0.0, 0.0, 0.0, 1.0]))
        np.testing.assert_allclose(grasps.poses[number], along, atol=1e-12)
        assert grasps.success_rates[number] == pytest.approx(n_stable * n_kept / 12)


def test_records_are_cached_and_a_damaged_one_is_replaced() -> None:
    known, config = KNOWN[:3], replace(QUICK_PREPARATION, tilts=(0.4,))
    first = validate_grasps(URDF, DATA.panda_urdf, known, config)
    assert len(first.poses) >= len(known)
    assert set(first.success_rates) <= {0.0, 1.0}
    path = get_validation_record_path(URDF, DATA.panda_urdf, known, config)
    np.savez(path, record=np.array([(-1, 0, 0, 1)] * 3, dtype=np.int16))
    assert (validate_grasps(URDF, DATA.panda_urdf, known, config).success_rates == 0.0).all()
    path.write_bytes(b"no archive")
    again = validate_grasps(URDF, DATA.panda_urdf, known, config)
    np.testing.assert_array_equal(again.poses, first.poses)
    np.testing.assert_array_equal(again.success_rates, first.success_rates)


@pytest.mark.parametrize("robot", [PANDA, PANDA_CAMERA])
@pytest.mark.parametrize("dataset", ["synthetic", "dexycb"])
def test_shipped_records_are_found(
    dataset: str, robot: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The shipped records match the shipped objects, grasps and robots."""
    monkeypatch.setattr(validation_module, "_simulate_grasps", None)
    folder = request.getfixturevalue("real_data") if dataset == "dexycb" else None
    data, count = open_dataset(dataset, folder, robot), 0
    for name in CLASS_NAMES.values():
        known = load_hand_poses(data.load_grasps, name)
        if known is not None:
            found = validate_grasps(data.find_object_urdf(name), data.panda_urdf, known, GraspPreparationConfig())
            count += 1
            assert (found.success_rates > 0.0).any()
            assert len(found.poses) >= len(known)
    assert count >= 19
    assert not (tmp_path / "cache").exists()


@pytest.mark.slow
def test_a_simulation_selects_the_grasps_of_the_shipped_record(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo accepts and rejects the known grasps as PyBullet did, which made the shipped record."""
    config, some = GraspPreparationConfig(), slice(0, len(KNOWN), 4)
    shipped = get_validation_record(URDF, DATA.panda_urdf, KNOWN, config)[: len(KNOWN)][some]
    monkeypatch.setattr(validation_module, "load_validation_record", lambda name: None)
    made = get_validation_record(URDF, DATA.panda_urdf, KNOWN[some], replace(config, max_copies=0))
    good, found = (record[:, 1] * record[:, 3] > 0 for record in (shipped, made))
    assert 0 < good.sum() < len(good)
    assert (good == found).mean() > 0.9
