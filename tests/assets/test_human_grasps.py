import itertools

import numpy as np
import pytest

from handover_marl.assets.anthropometry import SUBJECT_SIZES
from handover_marl.assets.building.grasps import make_human_grasps
from handover_marl.assets.hand_model import SIDES, SUBJECTS, find_hand_urdf
from handover_marl.assets.human_grasps import (
    GRASPED_OBJECTS,
    GRASPS_FILE,
    LEVELS,
    WRIST_DISTANCE_QUANTILES,
    load_human_grasps,
)
from handover_marl.assets.shipped import find_object_urdf
from handover_marl.config import HandConfig
from handover_marl.datasets.generated.shapes import read_solid
from handover_marl.errors import UnknownNameError
from handover_marl.simulation.bullet.bodies import HandBody
from handover_marl.simulation.bullet.client import connect, load_urdf

# Bullet adds a margin of about a millimetre to both shapes of a pair.
MOST_OVERLAP, MARGINS = 0.008, 0.002
DIGIT_LINKS = [range(7 + 9 * digit, 16 + 9 * digit) for digit in range(5)]


def hand_and_object(name, subject, side, dof):
    client = connect()
    item = load_urdf(client, find_object_urdf(name), useFixedBase=True)
    hand = HandBody(client, find_hand_urdf(subject, side), list(dof), HandConfig())
    client.performCollisionDetection()
    return client, item, hand


def gaps_by_link(client, item, hand, within):
    """Return the smallest distance (m) from each hand link to the object by PyBullet, by link number."""
    gaps = {}
    for point in client.getClosestPoints(hand.id, item, within):
        gaps[point[3]] = min(gaps.get(point[3], np.inf), point[8])
    return gaps


def test_every_object_person_and_side_has_grasps_with_thumb_and_two_fingers():
    assert len(GRASPED_OBJECTS) == 20
    for name in GRASPED_OBJECTS:
        for subject, side in itertools.product(SUBJECTS, SIDES):
            grasps = load_human_grasps(name, subject, side)
            assert len(grasps) >= 12
            assert grasps.touching[:, 4].all()
            assert (grasps.touching[:, :4].sum(axis=1) >= 2).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", GRASPED_OBJECTS)
@pytest.mark.parametrize("side", SIDES)
def test_grasps_hold_in_the_simulator(name, side):
    rng = np.random.default_rng(GRASPED_OBJECTS.index(name))
    for subject in rng.choice(SUBJECTS, 2, replace=False):
        grasps = load_human_grasps(name, int(subject), side)
        row = int(rng.integers(len(grasps)))
        client, item, hand = hand_and_object(name, int(subject), side, grasps.compute_hand_dof(row))
        gaps = gaps_by_link(client, item, hand, 0.01)
        assert min(gaps.values()) > -(MOST_OVERLAP + MARGINS)
        near = [min(gaps.get(link, np.inf) for link in links) < 0.003 for links in DIGIT_LINKS]
        assert near[4]
        assert sum(near[:4]) >= 2


@pytest.mark.parametrize("name", GRASPED_OBJECTS)
def test_wrist_distances_have_dexycbs_distribution(name):
    ours = np.concatenate([load_human_grasps(name, s, side).wrist_distance for s in SUBJECTS for side in SIDES])
    levels = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
    recorded = np.interp(levels, LEVELS, WRIST_DISTANCE_QUANTILES[name])
    np.testing.assert_allclose(np.quantile(ours, levels), recorded, atol=0.012)


def test_built_grasps_are_like_the_shipped_ones():
    name, side = "009_gelatin_box", "left"
    built = make_human_grasps(name, read_solid(find_object_urdf(name)), SUBJECT_SIZES[0], side, 0)
    with np.load(GRASPS_FILE, allow_pickle=False) as archive:
        assert all(archive[key].dtype == values.dtype for key, values in built.items())
    shipped = load_human_grasps(name, 1, side)
    np.testing.assert_allclose(np.sort(built["wrist_distance"]), shipped.wrist_distance, atol=0.01)
    assert built["touching"][:, 4].all()
    assert (built["touching"][:, :4].sum(axis=1) >= 2).all()


def test_unknown_names_are_refused():
    for arguments in (("999_spoon", 1, "left"), ("025_mug", 0, "left"), ("025_mug", 1, "both")):
        with pytest.raises(UnknownNameError):
            load_human_grasps(*arguments)
