"""Tests of the shipped robot grasps and human grasps of the shipped objects."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from handover_marl.assets.building.grasps import make_human_grasps
from handover_marl.assets.hand_model import SIDES, SUBJECT_SIZES, SUBJECTS, Side, find_hand_urdf
from handover_marl.assets.human_grasps import (
    GRASPED_OBJECTS,
    GRASPS_FILE,
    LEVELS,
    WRIST_DISTANCE_QUANTILES,
    load_human_grasps,
)
from handover_marl.assets.shipped import (
    CLASSES_WITHOUT_GRASPS,
    GRASPS_PATH,
    find_object_urdf,
    load_object_grasps,
    load_validation_records,
)
from handover_marl.config import HandConfig
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.errors import DataFormatError, UnknownNameError
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.simulation.bullet.bodies import HandBody
from handover_marl.simulation.bullet.client import connect, load_urdf

GRASPABLE = tuple(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
# Bullet adds a margin of about a millimetre to both shapes of a pair.
MOST_OVERLAP, MARGINS = 0.008, 0.002
DIGIT_LINKS = [range(7 + 9 * digit, 16 + 9 * digit) for digit in range(5)]


@pytest.mark.parametrize("name", GRASPABLE)
def test_object_lies_between_the_open_fingers(name: str) -> None:
    solid = read_solid(find_object_urdf(name))
    across = np.linspace(-0.04, 0.04, 31)  # between the open fingers, along the gripper frame's x
    depths = np.linspace(0.084, 0.111, 6)  # along the finger pads
    local = np.stack([*np.meshgrid(across, [0.0], depths, indexing="ij"), np.ones((31, 1, 6))], axis=-1).reshape(-1, 4)
    grasps = load_object_grasps(name)
    assert grasps is not None
    points = (local @ grasps.swapaxes(1, 2))[..., :3]
    outside = (solid.compute_distances(points) > 0.0).reshape(-1, 31, 6)
    assert outside[:, [0, -1]].all()  # where the fingers are
    assert not outside.all(axis=(1, 2)).any()  # between their pads


def test_classes_without_grasps_and_bad_names_and_files(tmp_path: Path) -> None:
    assert all(load_object_grasps(name) is None for name in CLASSES_WITHOUT_GRASPS)
    with np.load(GRASPS_PATH, allow_pickle=False) as archive:
        assert sorted(archive.files) == sorted(GRASPABLE)
    with pytest.raises(UnknownNameError, match="025_cup"):
        load_object_grasps("025_cup")
    (tmp_path / "damaged.npz").write_bytes(b"PK no archive")
    with pytest.raises(DataFormatError, match="damaged"):
        load_validation_records(tmp_path / "damaged.npz")


@pytest.mark.parametrize("name", GRASPED_OBJECTS)
def test_human_grasps_have_thumb_and_two_fingers_and_dexycbs_distances(name: str) -> None:
    grasps = [load_human_grasps(name, subject, side) for subject, side in itertools.product(SUBJECTS, SIDES)]
    for one in grasps:
        assert len(one) >= 12
        assert one.touching[:, 4].all()
        assert (one.touching[:, :4].sum(axis=1) >= 2).all()
    levels = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
    recorded = np.interp(levels, LEVELS, WRIST_DISTANCE_QUANTILES[name])
    ours = np.quantile(np.concatenate([one.wrist_distance for one in grasps]), levels)
    np.testing.assert_allclose(ours, recorded, atol=0.012)


@pytest.mark.slow
@pytest.mark.parametrize("name", GRASPED_OBJECTS)
@pytest.mark.parametrize("side", SIDES)
def test_human_grasps_hold_in_the_simulator(name: str, side: Side) -> None:
    rng, client = np.random.default_rng(GRASPED_OBJECTS.index(name)), connect()
    subject = int(rng.choice(SUBJECTS))
    grasps = load_human_grasps(name, subject, side)
    item = load_urdf(client, find_object_urdf(name), useFixedBase=True)
    dof = grasps.compute_hand_dof()[int(rng.integers(len(grasps)))]
    hand = HandBody(client, find_hand_urdf(subject, side), list(dof), HandConfig())
    client.performCollisionDetection()
    gaps: dict[int, float] = {}
    for point in client.getClosestPoints(hand.id, item, 0.01):
        gaps[point[3]] = min(gaps.get(point[3], np.inf), point[8])
    assert min(gaps.values()) > -(MOST_OVERLAP + MARGINS)
    near = [min(gaps.get(link, np.inf) for link in links) < 0.003 for links in DIGIT_LINKS]
    assert near[4]
    assert sum(near[:4]) >= 2


def test_built_human_grasps_are_like_the_shipped_ones() -> None:
    name = "009_gelatin_box"
    built = make_human_grasps(name, read_solid(find_object_urdf(name)), SUBJECT_SIZES[0], "left", 0)
    with np.load(GRASPS_FILE, allow_pickle=False) as archive:
        assert all(archive[key].dtype == values.dtype for key, values in built.items())
    shipped = load_human_grasps(name, 1, "left")
    np.testing.assert_allclose(np.sort(built["wrist_distance"]), shipped.wrist_distance, atol=0.01)
    assert built["touching"][:, 4].all()
