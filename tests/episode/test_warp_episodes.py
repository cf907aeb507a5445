"""Tests of episodes in MuJoCo Warp, which agree with episodes in MuJoCo. On Warp's CPU device, kernels compile once."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco_warp", reason="needs the extra `warp`")

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.episode.episode_batch import EpisodeBatch
from handover_marl.episode.referee import RELEASE_REASONS, EpisodeStatus, ReleaseReason
from handover_marl.geometry.arrays import to_numpy
from handover_marl.simulation.engines import WARP, BatchBackend
from tests.simulation.test_worlds import load_late_scene

pytestmark = pytest.mark.slow

# As many rows as in the tests of the worlds, so that they share kernels.
COUNT = 3
#: Scenes in which the object is picked up after some 100 steps at twice the recorded speed.
SCENES = (load_late_scene(8, 600), load_late_scene(211, 600))
HORIZON, PERIOD = 450, 100
CONFIG = replace(OFFICIAL_CONFIG, protocol=replace(OFFICIAL_CONFIG.protocol, horizon_steps=HORIZON))


def compare(arrays: EpisodeBatch, tensors: EpisodeBatch, atol: float) -> None:
    """Compare observations and infos of both batches."""
    rows, indices = np.arange(len(SCENES)), tensors.arrays.arange(len(SCENES))
    arrays.update_state(rows)
    tensors.update_state(indices)
    expected, found = arrays.select_giver_observation(rows), tensors.select_giver_observation(indices)
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        # Here motors move the objects, in MuJoCo's sleeping worlds equations: an object turns at another rate at its
        # release, and falls accordingly.
        tolerance = atol * np.ones(values.shape[-1])
        tolerance[...] *= 20.0 if key == "robot_joint_velocity" else 1.0
        tolerance[3:] *= 60.0 if key == "object_poses" else 1.0
        assert (np.abs(to_numpy(found[key]) - values) <= tolerance).all(), key
        assert to_numpy(found[key]).dtype == values.dtype
    infos = tensors.make_infos(indices)
    for key, values in arrays.make_infos(rows).items():
        np.testing.assert_array_equal(infos[key], values, err_msg=key)


def test_episodes_agree_with_those_of_mujoco() -> None:
    arrays, tensors = EpisodeBatch(CONFIG, COUNT, BatchBackend()), EpisodeBatch(CONFIG, COUNT, BatchBackend(WARP))
    rows = np.arange(len(SCENES))
    indices = tensors.arrays.asarray(rows)
    for row, scene in enumerate(SCENES):
        arrays.reset(row, scene)
        tensors.reset(row, scene)
    compare(arrays, tensors, 1e-6)
    targets = arrays.select_state(rows)["robot_joint_position"]
    rng = np.random.default_rng(0)
    for period in range(-(-HORIZON // PERIOD)):
        targets[:, :7] += rng.uniform(-0.1, 0.1, (len(SCENES), 7)).astype(np.float32)
        actions = np.zeros((len(SCENES), 8), dtype=np.float32)
        actions[:, 0] = 1.0
        if period == 3:
            assert arrays.motion.holding[rows].all()
            actions[0, 7], actions[1, 1:7] = 1.0, 0.05
        arrays.advance(rows, targets, PERIOD, actions)
        given = tensors.arrays.asarray(targets), tensors.arrays.asarray(actions)
        tensors.advance(indices, given[0], PERIOD, given[1])
        compare(arrays, tensors, 5e-4)
        assert not to_numpy(tensors.are_grasped(indices)).any()
    assert set(arrays.referees.status[rows].tolist()) == {int(EpisodeStatus.TIMEOUT)}
    release = RELEASE_REASONS.index(ReleaseReason.VOLUNTARY)
    assert to_numpy(tensors.referees.release_reason[indices]).tolist() == [release, -1]
    assert to_numpy(tensors.released[indices]).tolist() == [True, False]
    assert tensors.read_contacts(0).object_height == pytest.approx(arrays.read_contacts(0).object_height, abs=1e-2)
    tensors.reset(0, SCENES[1])
    arrays.reset(0, SCENES[1])
    compare(arrays, tensors, 5e-4)
