"""Tests of batches of worlds: their rows, models and memory."""

import gc
import weakref

import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.simulation.mujoco.batches import simulation as batch_simulation
from handover_marl.simulation.mujoco.batches.simulation import BatchSimulation
from handover_marl.simulation.mujoco.scene_model import SceneModel, load_scene_model

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


@pytest.fixture
def max_empty_batches(monkeypatch: pytest.MonkeyPatch) -> int:
    """Keep at most two batches without worlds."""
    monkeypatch.setattr(batch_simulation, "_MAX_EMPTY_BATCHES", 2)
    return 2


def n_batches(simulation: BatchSimulation) -> int:
    return sum(len(batches) for batches in simulation._batches.values())


def test_memory_does_not_grow_with_the_scenes_that_were_played(max_empty_batches: int) -> None:
    simulation, slot = BatchSimulation(1), None
    for model in models(6) * 2:
        slot = simulation.load_scene(model, slot)
        assert slot.world_batch.batch.model.nq == model.model.nq
        assert n_batches(simulation) <= max_empty_batches + 1


def test_batches_with_worlds_are_kept(max_empty_batches: int) -> None:
    simulation = BatchSimulation(2)
    first, *others = models(6)
    stays, moves = simulation.load_scene(first), None
    world_batch = stays.world_batch
    for model in others:
        moves = simulation.load_scene(model, moves)
    assert stays.world_batch is world_batch
    moves = simulation.load_scene(first, moves)
    assert moves.world_batch is world_batch
    assert moves.row != stays.row
    assert n_batches(simulation) <= max_empty_batches + 1


def test_free_rows_hold_no_model(max_empty_batches: int) -> None:
    (model,) = models(1)
    simulation = BatchSimulation(2)
    slot = simulation.load_scene(model)
    world_batch, row = slot.world_batch, slot.row
    world_batch.models[row] = model.variants.select(True, False)
    simulation.free(slot)
    assert world_batch.models[row] is world_batch.scene.model
    assert world_batch.is_empty


def test_model_variants_are_shared_while_worlds_hold_them() -> None:
    (model,) = models(1)
    simulation = BatchSimulation(2)
    slots = [simulation.load_scene(model), simulation.load_scene(model)]
    shared = slots[0].select_model(hand=False)
    assert shared is slots[1].select_model(hand=False) is slots[0].select_model(hand=False)
    assert slots[0].select_model(hand=True) is model.model
    held = weakref.ref(shared)
    del shared
    slots[0].world_batch.select_models(slots, [False, False])
    for number, slot in enumerate(slots):
        assert held() is not None
        slots[number] = simulation.load_scene(model, slot)
    del slot
    slots[0].world_batch.select_models(slots, [True, True])
    gc.collect()
    assert held() is None
