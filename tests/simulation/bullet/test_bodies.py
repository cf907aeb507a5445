"""Tests of PyBullet bodies: models of other things, and the collision masks of objects."""

import shutil
from collections.abc import Callable
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

OBJECT = "003_cracker_box/model_normalized.urdf"
Load = Callable[[Any, Path], object]


@pytest.mark.parametrize(
    ("load", "urdf", "message"),
    [
        (
            lambda client, urdf: ObjectBody(client, urdf, 2, ObjectConfig(), [0.0] * 6),
            "table/table.urdf",
            "'table' loaded as ObjectBody must have 6 moving joints, got 0",
        ),
        (
            lambda client, urdf: HandBody(client, urdf, [0.0] * 51, HandConfig()),
            OBJECT,
            "'object' loaded as HandBody must have 51 moving joints, got 6",
        ),
        (
            lambda client, urdf: PandaBody(client, urdf, PandaConfig()),
            OBJECT,
            "'object' loaded as PandaBody must have 9 moving joints, got 6",
        ),
    ],
)
def test_models_that_are_something_else(fake_data: Path, load: Load, urdf: str, message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        load(connect(), fake_data / "assets" / urdf)


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
