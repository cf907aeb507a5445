"""Grasps that were tried out: what their record tells, what is kept of it, and what ships."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handover_marl.assets.object_models import object_urdf
from handover_marl.assets.shipped_trials import TRIALS_PATH, Record, all_trials, shipped_trials
from handover_marl.datasets import open_dataset
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.errors import DataFormatError
from handover_marl.models.panda import PANDA, PANDA_CAMERA
from handover_marl.models.poses import IDENTITY, compose
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive import trials
from handover_marl.receivers.reactive.grasps import GraspTrials, of_record, tilted
from handover_marl.receivers.reactive.trials import record_file, trial_record, tried_grasps
from handover_marl.sim.grasp_trial import TrialConfig, trial_engine

DATA = SyntheticDataset()
BRICK = "061_foam_brick"
# Trials so short that all stand them: what they find out is tested where they are.
QUICK = GraspTrials(
    tilts=(0.4,),
    aside=(),
    around=(),
    slip=1.0,
    held_time=0.15,
    free_time=0.002,
    trial=TrialConfig(close_time=0.15, shake_time=0.002),
)
needs_bullet = pytest.mark.skipif(trial_engine() != "bullet", reason="what ships was tried in PyBullet")


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def known_grasps(name: str) -> np.ndarray:
    known = ObjectGrasps(DATA.grasps).in_object(name)
    assert known is not None
    return known


def test_copies_keep_the_pads_in_place() -> None:
    rng = np.random.default_rng(0)
    known = np.concatenate([rng.normal(size=(5, 3)), rng.normal(size=(5, 4))], axis=1)
    known[:, 3:] /= np.linalg.norm(known[:, 3:], axis=1, keepdims=True)
    config = GraspTrials(tilts=(0.4, -0.8))
    copies = tilted(known, config)
    assert copies.shape == (10, 7)

    def pads(poses: np.ndarray) -> np.ndarray:
        return np.asarray(compose(poses, np.array([0.0, 0.0, config.pads, 0.0, 0.0, 0.0, 1.0]))[:, :3])

    np.testing.assert_allclose(pads(copies), np.tile(pads(known), (2, 1)), atol=1e-9)


@given(st.data())
@settings(max_examples=50, deadline=None)
def test_a_record_tells_of_grasps(draw: st.DataObject) -> None:
    config, n = GraspTrials(), draw.draw(st.integers(1, 8))
    known = known_grasps(BRICK)[:n]
    copies = sorted(draw.draw(st.sets(st.integers(0, 4 * n - 1))))
    row = st.tuples(st.integers(0, 3), st.integers(0, 4), st.integers(0, 4))
    rows = draw.draw(st.lists(row, min_size=n + len(copies), max_size=n + len(copies)))
    record = np.array([(copy, *row) for copy, row in zip([-1] * n + copies, rows, strict=True)], dtype=np.int16)
    told = of_record(record, known, config)
    bare = np.concatenate([known, tilted(known, config)[copies]])
    for number, (stood, way, kept) in enumerate(rows):
        reach = config.deeper[way - 1] if way else 0.0
        along = compose(bare[number], np.array([0.0, 0.0, reach, 0.0, 0.0, 0.0, 1.0]))
        np.testing.assert_allclose(told.poses[number], along, atol=1e-12)
        assert told.holds[number] == pytest.approx(stood * kept / 12)


@pytest.mark.parametrize(
    ("place", "value"),
    [((0, 0), 0), ((2, 0), -1), ((2, 0), 99), ((0, 1), -1), ((0, 1), 2), ((1, 2), 5), ((1, 3), 2), ((2, 3), -2)],
)
def test_records_of_something_else(place: tuple[int, int], value: int) -> None:
    known, record = known_grasps(BRICK)[:2], np.array([(-1, 1, 0, 1), (-1, 1, 4, 1), (1, 1, 0, 1)], dtype=np.int16)
    of_record(record, known, QUICK)
    record[place] = value
    with pytest.raises(ValueError, match="a record of other"):
        of_record(record, known, QUICK)


def test_every_robot_has_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials that need no particular robot are shared; what its fingers hold is not."""
    known, done = np.array([IDENTITY]), []

    def tried(*arguments: object) -> Record:
        done.append("tried")
        return np.array([(-1, 3, 0, 0)], dtype=np.int16)

    def finished(urdf: Path, panda: Path, stood: Record, *arguments: object) -> Record:
        done.append(panda.name)
        return np.array([(-1, stood[0, 1], 0, 4 if panda.name == "panda" else 2)], dtype=np.int16)

    monkeypatch.setattr(trials, "_try", tried)
    monkeypatch.setattr(trials, "_finish", finished)
    robots = [tmp_path / "panda", tmp_path / "panda_camera"]
    for robot in robots:
        robot.write_text(robot.name)
    urdf = object_urdf("025_mug")
    for _ in range(2):
        found = [tried_grasps(urdf, robot, known, GraspTrials()) for robot in robots]
        assert [float(grasps.holds[0]) for grasps in found] == [1.0, 0.5]
    assert done == ["tried", "panda", "panda_camera"]


@pytest.mark.parametrize("spoilt", [b"no archive", np.array([(-1, 9, 0, 0)], dtype=np.int16), np.zeros(3)])
def test_trials_are_kept_and_made_anew_when_spoilt(tmp_path: Path, spoilt: object) -> None:
    known, urdf = known_grasps(BRICK)[:3], DATA.object_urdf(BRICK)
    first = tried_grasps(urdf, DATA.panda_urdf, known, QUICK)
    assert len(first.poses) >= len(known)
    assert set(first.holds) <= {0.0, 1.0}
    kept = record_file(urdf, DATA.panda_urdf, known, QUICK)
    other = np.array([(-1, 0, 0, 1)] * 3, dtype=np.int16)
    np.savez(kept, record=other)
    assert (tried_grasps(urdf, DATA.panda_urdf, known, QUICK).holds == 0.0).all()
    if isinstance(spoilt, bytes):
        kept.write_bytes(spoilt)
    else:
        np.savez(kept, record=spoilt)
    again = tried_grasps(urdf, DATA.panda_urdf, known, QUICK)
    np.testing.assert_array_equal(again.poses, first.poses)
    np.testing.assert_array_equal(again.holds, first.holds)


@needs_bullet
@pytest.mark.parametrize("robot", [PANDA, PANDA_CAMERA])
@pytest.mark.parametrize("dataset", ["synthetic", "dexycb"])
def test_nobody_waits_for_known_objects(
    dataset: str, robot: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also: what ships is still about the objects, grasps and robots that ship."""
    monkeypatch.setattr(trials, "grasp_trial", None)
    folder = request.getfixturevalue("real_data") if dataset == "dexycb" else None
    data = open_dataset(dataset, folder, robot)
    grasps, count = ObjectGrasps(data.grasps), 0
    for name in CLASS_NAMES.values():
        known = grasps.in_object(name)
        if known is not None:
            found = tried_grasps(data.object_urdf(name), data.panda_urdf, known, GraspTrials())
            count += 1
            assert (found.holds > 0.0).any()
            assert len(found.poses) >= len(known)
    assert count >= 19
    assert not (tmp_path / "cache").exists()


@needs_bullet
@pytest.mark.slow
def test_what_ships_is_what_trials_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    known, urdf = known_grasps(BRICK), DATA.object_urdf(BRICK)
    shipped = trial_record(urdf, DATA.panda_urdf, known, GraspTrials())
    monkeypatch.setattr(trials, "shipped_trials", lambda name: None)
    np.testing.assert_array_equal(trial_record(urdf, DATA.panda_urdf, known, GraspTrials()), shipped)


def test_damaged_trials(tmp_path: Path) -> None:
    path = tmp_path / "trials.npz"
    assert shipped_trials("mug", path) is None
    all_trials.cache_clear()
    shutil.copy(TRIALS_PATH, path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(DataFormatError, match=r"not a readable file of trials .* install the library again"):
        shipped_trials("mug", path)
    np.savez(path, mug=np.zeros((3, 4)))
    with pytest.raises(DataFormatError, match=r"mug must be integers of shape \(n, 4\)"):
        shipped_trials("mug", path)
