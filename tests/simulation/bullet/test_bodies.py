"""Tests of PyBullet bodies: models of other things, and the collision masks of objects."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from handover_marl.assets.shipped import PANDA_URDF
from handover_marl.config import HandConfig, ObjectConfig, PandaConfig
from handover_marl.errors import SimulationError
from handover_marl.geometry.ycb import SCENE_CLASSES
from handover_marl.simulation.bullet.bodies import HAND_MASK, TABLE_MASK, HandBody, ObjectBody, PandaBody
from handover_marl.simulation.bullet.bodies import compute_object_masks as compute_masks
from handover_marl.simulation.bullet.client import connect

URDFS = {"table": "table/table.urdf", "object": "003_cracker_box/model_normalized.urdf"}


@pytest.mark.parametrize(
    ("kind", "arguments", "other", "expected", "found"),
    [
        (ObjectBody, (2, ObjectConfig(), [0.0] * 6), "table", 6, 0),
        (HandBody, ([0.0] * 51, HandConfig()), "object", 51, 6),
        (PandaBody, (PandaConfig(),), "object", 9, 6),
    ],
)
def test_models_that_are_something_else(
    fake_data: Path, kind: type[Any], arguments: tuple[Any, ...], other: str, expected: int, found: int
) -> None:
    message = f"'{other}' loaded as {kind.__name__} must have {expected} moving joints, got {found}"
    with pytest.raises(SimulationError, match=message):
        kind(connect(), fake_data / "assets" / URDFS[other], *arguments)


def test_a_panda_without_a_link(tmp_path: Path) -> None:
    urdf = shutil.copytree(PANDA_URDF.parent, tmp_path / "panda") / PANDA_URDF.name
    urdf.write_text(urdf.read_text().replace('"panda_leftfinger"', '"renamed"'))
    with pytest.raises(SimulationError, match=r"loaded as PandaBody has no link 'panda_leftfinger'.*renamed"):
        PandaBody(connect(), urdf, PandaConfig())


def test_masks_of_objects() -> None:
    """The masks of YCB classes are HandoverSim's; no two bodies share a bit."""
    assert compute_masks(SCENE_CLASSES[:5]) == [2, 4, 8, 16, 32]
    assert compute_masks((21, 1)) == [2**20, 2]
    for class_ids in ((1, 1, 1), (150, 7, 22, 7), tuple(range(22, 51))):
        masks = [TABLE_MASK, HAND_MASK, *compute_masks(class_ids)]
        assert all(mask.bit_count() == 1 and mask < 2**31 for mask in masks)
        assert len(set(masks)) == len(masks)
    with pytest.raises(SimulationError, match="at most 29 objects, got 30"):
        compute_masks(range(22, 52))
