"""Tests of grasp validation, its cache, and the shipped records."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.datasets import open_dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.geometry.poses import compose
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.receivers.grasp_library import GraspLibrary
from handover_marl.receivers.reactive import grasp_validation as validation_module
from handover_marl.receivers.reactive.grasp_validation import (
    get_validation_record,
    get_validation_record_path,
    validate_grasps,
)
from handover_marl.receivers.reactive.grasps import GraspPreparationConfig, grasps_from_record, tilt_grasps
from tests.receivers.quick import QUICK_PREPARATION

DATA = SyntheticDataset()
BRICK = "061_foam_brick"
QUICK = replace(QUICK_PREPARATION, tilts=(0.4,))


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def known_grasps(name: str) -> np.ndarray:
    known = GraspLibrary(DATA.load_grasps).get_hand_poses_in_object(name)
    assert known is not None
    return known


@given(st.data())
@settings(max_examples=50)
def test_grasps_from_record(draw: st.DataObject) -> None:
    config, n = GraspPreparationConfig(), draw.draw(st.integers(1, 8))
    known = known_grasps(BRICK)[:n]
    copies = sorted(draw.draw(st.sets(st.integers(0, 4 * n - 1))))
    row = st.tuples(st.integers(0, 3), st.integers(0, 4), st.integers(0, 4))
    rows = draw.draw(st.lists(row, min_size=n + len(copies), max_size=n + len(copies)))
    record = np.array([(copy, *row) for copy, row in zip([-1] * n + copies, rows, strict=True)], dtype=np.int16)
    grasps = grasps_from_record(record, known, config)
    bare = np.concatenate([known, tilt_grasps(known, config)[copies]])
    for number, (n_stable, advance, n_kept) in enumerate(rows):
        distance = config.advances[advance - 1] if advance else 0.0
        along = compose(bare[number], np.array([0.0, 0.0, distance, 0.0, 0.0, 0.0, 1.0]))
        np.testing.assert_allclose(grasps.poses[number], along, atol=1e-12)
        assert grasps.success_rates[number] == pytest.approx(n_stable * n_kept / 12)


@pytest.mark.parametrize(
    ("place", "value"),
    [((0, 0), 0), ((2, 0), -1), ((2, 0), 99), ((0, 1), -1), ((0, 1), 2), ((1, 2), 5), ((1, 3), 2), ((2, 3), -2)],
)
def test_invalid_records(place: tuple[int, int], value: int) -> None:
    known, record = known_grasps(BRICK)[:2], np.array([(-1, 1, 0, 1), (-1, 1, 4, 1), (1, 1, 0, 1)], dtype=np.int16)
    grasps_from_record(record, known, QUICK)
    record[place] = value
    with pytest.raises(ValueError, match="the record belongs to"):
        grasps_from_record(record, known, QUICK)


@pytest.mark.parametrize("damaged", [b"no archive", np.array([(-1, 9, 0, 0)], dtype=np.int16), np.zeros(3)])
def test_damaged_cache_is_replaced(tmp_path: Path, damaged: object) -> None:
    known, urdf = known_grasps(BRICK)[:3], DATA.find_object_urdf(BRICK)
    first = validate_grasps(urdf, DATA.panda_urdf, known, QUICK)
    assert len(first.poses) >= len(known)
    assert set(first.success_rates) <= {0.0, 1.0}
    path = get_validation_record_path(urdf, DATA.panda_urdf, known, QUICK)
    other = np.array([(-1, 0, 0, 1)] * 3, dtype=np.int16)
    np.savez(path, record=other)
    assert (validate_grasps(urdf, DATA.panda_urdf, known, QUICK).success_rates == 0.0).all()
    if isinstance(damaged, bytes):
        path.write_bytes(damaged)
    else:
        np.savez(path, record=damaged)
    again = validate_grasps(urdf, DATA.panda_urdf, known, QUICK)
    np.testing.assert_array_equal(again.poses, first.poses)
    np.testing.assert_array_equal(again.success_rates, first.success_rates)


@pytest.mark.parametrize("robot", [PANDA, PANDA_CAMERA])
@pytest.mark.parametrize("dataset", ["synthetic", "dexycb"])
def test_shipped_records_are_found(
    dataset: str, robot: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The shipped records match the shipped objects, grasps and robots."""
    monkeypatch.setattr(validation_module, "make_grasp_validator", None)
    folder = request.getfixturevalue("real_data") if dataset == "dexycb" else None
    data = open_dataset(dataset, folder, robot)
    grasps, count = GraspLibrary(data.load_grasps), 0
    for name in CLASS_NAMES.values():
        known = grasps.get_hand_poses_in_object(name)
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
    known, urdf, config = known_grasps(BRICK), DATA.find_object_urdf(BRICK), GraspPreparationConfig()
    shipped = get_validation_record(urdf, DATA.panda_urdf, known, config)[: len(known)]
    monkeypatch.setattr(validation_module, "load_validation_record", lambda name: None)
    made = get_validation_record(urdf, DATA.panda_urdf, known, replace(config, max_copies=5))[: len(known)]
    good, found = (record[:, 1] * record[:, 3] > 0 for record in (shipped, made))
    assert (good == found).mean() > 0.9
