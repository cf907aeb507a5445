"""Where worlds are simulated side by side, and what is kept of those that have gone."""

import gc
import weakref

import pytest

pytest.importorskip("mujoco")

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.sim.mujoco import lanes
from handover_marl.sim.mujoco.lanes import Lane, Lanes
from handover_marl.sim.mujoco.scene_model import SceneModel, scene_model

CONFIG = PhysicsConfig()
DATA = SyntheticDataset()


def models(count: int) -> list[SceneModel]:
    """Models of different bodies."""
    found: dict[SceneAssets, SceneModel] = {}
    for scene_id in DATA.split("s0", "train"):
        assets = DATA.scene(scene_id).assets
        if assets not in found:
            found[assets] = scene_model(assets, CONFIG)
        if len(found) == count:
            break
    return list(found.values())


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> int:
    """How many groups without worlds are kept."""
    monkeypatch.setattr(lanes, "_SPARE", 2)
    return 2


def n_groups(kept: Lanes) -> int:
    return sum(len(groups) for groups in kept._groups.values())


def test_memory_does_not_grow_with_the_scenes_that_were_played(few: int) -> None:
    kept, lane = Lanes(1, CONFIG.gravity), Lane()
    for model in models(6) * 2:
        kept.enter(lane, model)
        assert lane.running.batch.model.nq == model.model.nq
        assert n_groups(kept) <= few + 1


def test_groups_with_worlds_are_kept(few: int) -> None:
    kept, stays, moves = Lanes(2, CONFIG.gravity), Lane(), Lane()
    first, *others = models(6)
    kept.enter(stays, first)
    group = stays.running
    for model in others:
        kept.enter(moves, model)
    assert stays.running is group
    kept.enter(moves, first)
    assert moves.running is group
    assert moves.row != stays.row
    assert n_groups(kept) <= few + 1


def test_a_row_that_is_left_holds_no_model(few: int) -> None:
    (model,) = models(1)
    kept, lane = Lanes(2, CONFIG.gravity), Lane()
    kept.enter(lane, model)
    group, row = lane.running, lane.row
    group.models[row] = model.variants.of(True, False)
    kept.leave(lane)
    assert group.models[row] is group.scene.model
    assert group.empty
    assert lane.group is None


def test_variants_are_shared_and_last_as_long_as_worlds_hold_them() -> None:
    (model,) = models(1)
    kept, lanes_here = Lanes(2, CONFIG.gravity), [Lane(), Lane()]
    for lane in lanes_here:
        kept.enter(lane, model)
    shared = lanes_here[0].variant(hand=False)
    assert shared is lanes_here[1].variant(hand=False) is lanes_here[0].variant(hand=False)
    assert lanes_here[0].variant(hand=True) is model.model
    held = weakref.ref(shared)
    del shared
    lanes.feel(lanes_here, [False, False])
    for lane in lanes_here:
        assert held() is not None
        kept.enter(lane, model)
    lanes.feel(lanes_here, [True, True])
    gc.collect()
    assert held() is None
