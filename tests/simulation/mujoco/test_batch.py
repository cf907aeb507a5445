"""Batches of worlds: rows, groups of models, and the memory that they hold."""

import gc
import weakref

import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.simulation.mujoco import batch
from handover_marl.simulation.mujoco.batch import BatchSimulation
from handover_marl.simulation.mujoco.control import select_model_variants
from handover_marl.simulation.mujoco.scene_model import SceneModel, load_scene_model

CONFIG = PhysicsConfig()
DATA = SyntheticDataset()


def models(count: int) -> list[SceneModel]:
    """Models of different bodies."""
    found: dict[SceneAssets, SceneModel] = {}
    for scene_id in DATA.list_scenes("s0", "train"):
        assets = DATA.load_scene(scene_id).assets
        if assets not in found:
            found[assets] = load_scene_model(assets, CONFIG)
        if len(found) == count:
            break
    return list(found.values())


@pytest.fixture
def max_empty_groups(monkeypatch: pytest.MonkeyPatch) -> int:
    """Keep at most two groups without worlds."""
    monkeypatch.setattr(batch, "_MAX_EMPTY_GROUPS", 2)
    return 2


def n_groups(simulation: BatchSimulation) -> int:
    return sum(len(groups) for groups in simulation._groups.values())


def test_memory_does_not_grow_with_the_scenes_that_were_played(max_empty_groups: int) -> None:
    simulation, slot = BatchSimulation(1), None
    for model in models(6) * 2:
        slot = simulation.load_scene(model, slot)
        assert slot.group.batch.model.nq == model.model.nq
        assert n_groups(simulation) <= max_empty_groups + 1


def test_groups_with_worlds_are_kept(max_empty_groups: int) -> None:
    simulation = BatchSimulation(2)
    first, *others = models(6)
    stays, moves = simulation.load_scene(first), None
    group = stays.group
    for model in others:
        moves = simulation.load_scene(model, moves)
    assert stays.group is group
    moves = simulation.load_scene(first, moves)
    assert moves.group is group
    assert moves.row != stays.row
    assert n_groups(simulation) <= max_empty_groups + 1


def test_free_rows_hold_no_model(max_empty_groups: int) -> None:
    (model,) = models(1)
    simulation = BatchSimulation(2)
    slot = simulation.load_scene(model)
    group, row = slot.group, slot.row
    group.models[row] = model.variants.select(True, False)
    simulation.free(slot)
    assert group.models[row] is group.scene.model
    assert group.is_empty


def test_model_variants_are_shared_while_worlds_hold_them() -> None:
    (model,) = models(1)
    simulation = BatchSimulation(2)
    slots = [simulation.load_scene(model), simulation.load_scene(model)]
    shared = slots[0].select_model(hand=False)
    assert shared is slots[1].select_model(hand=False) is slots[0].select_model(hand=False)
    assert slots[0].select_model(hand=True) is model.model
    held = weakref.ref(shared)
    del shared
    select_model_variants(slots, [False, False])
    for number, slot in enumerate(slots):
        assert held() is not None
        slots[number] = simulation.load_scene(model, slot)
    del slot
    select_model_variants(slots, [True, True])
    gc.collect()
    assert held() is None
