"""Tests of the simulation of many worlds: their batches, models and memory."""

import gc
import weakref

import numpy as np
import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.simulation.mujoco.batches import simulation as batch_simulation
from handover_marl.simulation.mujoco.batches.simulation import BatchSimulation
from handover_marl.simulation.mujoco.models.scene_model import SceneModel, load_scene_model

CONFIG = PhysicsConfig()
DATA = SyntheticDataset()


def models(count: int) -> list[SceneModel]:
    """Return models of scenes with different bodies."""
    found: dict[SceneAssets, SceneModel] = {}
    for scene_id in DATA.list_scenes("s0", "train"):
        assets = DATA.load_scene(scene_id).assets
        if assets not in found:
            found[assets] = load_scene_model(assets, CONFIG)
        if len(found) == count:
            break
    return list(found.values())


@pytest.mark.slow
def test_memory_does_not_grow_with_the_scenes_that_were_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_simulation, "_MAX_BATCHES", 2)
    simulation, batches = BatchSimulation(), []
    for model in models(6) * 2:
        batches.append(weakref.ref(simulation.load_scene(model).batch))
    gc.collect()
    assert len({id(batch()) for batch in batches if batch() is not None}) <= 2


def test_worlds_that_share_a_batch_keep_their_own_state() -> None:
    (model,) = models(1)
    simulation = BatchSimulation()
    together, alone = [simulation.load_scene(model) for _ in range(2)], BatchSimulation().load_scene(model)
    steps = 20
    controls = [
        np.tile(np.concatenate([one.ctrl, one.mocap_pos.ravel(), one.mocap_quat.ravel()]), (steps, 1))
        for one in together
    ]
    controls[1][:, model.robot_ctrl] = 0.3
    rollout = simulation.simulate(together, [True, False], controls)
    separate = BatchSimulation()
    separate.simulate([alone], [False], controls[1:])
    np.testing.assert_array_equal(together[1].qpos, alone.qpos)
    np.testing.assert_array_equal(together[1].sensordata, alone.sensordata)
    assert not np.array_equal(together[0].qpos, alone.qpos)
    # A world that is set back continues as if it had not been simulated further.
    together[1].set_step(*(array[1, 6] for array in rollout))
    simulation.simulate([together[1]], [False], [controls[1][7:]])
    np.testing.assert_array_equal(together[1].qpos, alone.qpos)
    np.testing.assert_array_equal(together[1].qvel, alone.qvel)
