import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handover_marl.models.panda import HALF_TURN
from handover_marl.models.poses import compose, compose_point, inverse
from handover_marl.receivers.vision.object_track import Trust
from handover_marl.receivers.vision.percept import Percept, PerceptConfig, Told

Array = NDArray[np.float64]

LINK = np.array([0.4, 0.1, 1.2, *Rotation.from_euler("xyz", [2.0, 0.3, -0.4]).as_quat()])
MIDDLE = np.array([0.6, 0.2, 1.1])
GRASPS = np.array(
    [
        [0.6, 0.2, 1.2, *Rotation.from_euler("x", np.pi).as_quat()],
        [0.5, 0.2, 1.1, *Rotation.from_euler("y", np.pi / 2).as_quat()],
        [0.6, 0.3, 1.1, *Rotation.from_euler("x", np.pi / 2).as_quat()],
    ]
)
RNG = np.random.default_rng(0)
ITEM = 0.02 * RNG.normal(size=(100, 3)) + [0.0, 0.0, 0.3]
HAND = 0.02 * RNG.normal(size=(30, 3)) + [0.0, 0.05, 0.3]


class Teller:
    """Tells what is there, as seen from the hand link."""

    def __init__(self, grasps: Array = GRASPS, quality: tuple[float, ...] = (0.9, 0.5, 0.01)) -> None:
        self.grasps, self.quality, self.middle = grasps, np.array(quality), MIDDLE
        self.asked = 0

    def __call__(self, item: Array, hand: Array, velocity: Array, rng: np.random.Generator) -> Told:
        self.asked += 1
        middle = compose_point(inverse(LINK), self.middle)
        return Told(compose(inverse(LINK), self.grasps), self.quality, middle)


def in_world(percept: Percept) -> Array:
    moved = percept.grasps.copy()
    moved[:, :3] += percept.object_pose[:3]
    return moved


def same(one: Array, other: Array) -> bool:
    return bool(np.allclose(one[:3], other[:3], atol=1e-9) and abs(one[3:] @ other[3:]) > 1.0 - 1e-9)


def test_offers_grasps_worth_it_in_both_turns_the_best_first() -> None:
    percept = Percept(Teller(), PerceptConfig(), 0)
    assert not percept.seen
    percept.see(0.0, LINK, ITEM, HAND)
    assert percept.seen
    assert len(percept.grasps) == 4
    found = in_world(percept)
    half = compose(GRASPS, np.array(HALF_TURN))
    for pose, wanted in zip(found, [GRASPS[0], GRASPS[1], half[0], half[1]], strict=True):
        assert same(pose, wanted)
    np.testing.assert_allclose(percept.prices, -PerceptConfig().scale * np.log([0.9, 0.5, 0.9, 0.5]))


def test_all_grasps_and_tilted_copies_are_offered_where_nothing_else_helps() -> None:
    config = PerceptConfig()
    percept = Percept(Teller(), config, 0)
    percept.wider = True
    percept.see(0.0, LINK, ITEM, HAND)
    assert len(percept.grasps) == 2 * len(GRASPS) * (1 + len(config.tilts))
    found, pads = in_world(percept), np.array([0.0, 0.0, config.pads, 0.0, 0.0, 0.0, 1.0])
    places = {tuple(np.round(place, 6)) for place in compose(found, pads)[:, :3]}
    assert places == {tuple(np.round(place, 6)) for place in compose(GRASPS, pads)[:, :3]}
    np.testing.assert_allclose(np.sort(percept.prices)[-2:], config.tilted - config.scale * np.log(0.01))


def away(points: Array, others: Array) -> Array:
    """(n,) distances of points to the nearest of others."""
    found: Array = np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1)
    return found


def test_points_come_to_where_they_are_one_for_each_cube() -> None:
    config = PerceptConfig()
    percept = Percept(Teller(), config, 0)
    percept.see(0.0, LINK, ITEM, HAND)
    assert percept.hand is not None
    for balls, seen in ((percept.hand.centers, HAND), (percept.surface.centers + MIDDLE, ITEM)):
        assert away(balls, compose_point(LINK, seen)).max() < 1e-9
        assert away(compose_point(LINK, seen), balls).max() < config.cube * 3.0**0.5
        assert len(balls) < len(seen)


def test_few_points_are_no_view() -> None:
    teller = Teller()
    percept = Percept(teller, PerceptConfig(), 0)
    percept.see(0.0, LINK, ITEM[:5], HAND)
    assert not percept.seen
    assert teller.asked == 0
    assert len(percept.grasps) == 0


def test_the_chosen_grasp_stays_first_and_follows_what_is_told() -> None:
    teller = Teller()
    percept = Percept(teller, PerceptConfig(near=0.1, far=Trust(0.5, 0.1, 0.5)), 0)
    percept.see(0.0, LINK, ITEM, HAND)
    chosen = percept.grasps[0]
    percept.choose(chosen)
    teller.grasps = GRASPS + np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    percept.see(0.05, LINK, ITEM, HAND)
    np.testing.assert_allclose(percept.grasps[0][:3], chosen[:3] + np.array([0.005, 0.0, 0.0]), atol=1e-3)
    assert len(percept.grasps) == 5


def test_a_chosen_grasp_that_is_not_told_of_fades() -> None:
    teller = Teller()
    percept = Percept(teller, PerceptConfig(), 0)
    percept.see(0.0, LINK, ITEM, HAND)
    percept.choose(percept.grasps[0])
    percept.see(0.05, LINK, ITEM, HAND)
    before = percept.prices[0]
    teller.grasps, teller.quality = GRASPS[1:], np.array([0.5, 0.01])
    percept.see(0.1, LINK, ITEM, HAND)
    assert percept.prices[0] == pytest.approx(before + PerceptConfig().fading)
    percept.see(0.15, LINK, ITEM[:3], HAND)
    assert same(in_world(percept)[0], GRASPS[0])


def test_grasps_that_failed_cost_more_for_a_while() -> None:
    percept = Percept(Teller(), PerceptConfig(), 0)
    percept.see(0.0, LINK, ITEM, HAND)
    usual = percept.prices.copy()
    percept.fail(percept.grasps[0], until=1.0)
    percept.see(0.5, LINK, ITEM, HAND)
    assert (percept.prices - usual > 5.0).tolist() == [True, False, True, False]
    percept.see(1.5, LINK, ITEM, HAND)
    np.testing.assert_allclose(percept.prices, usual)


def near_percept(teller: Teller) -> Percept:
    """One that saw the object twice from near: there it has a look to match others with."""
    percept = Percept(teller, PerceptConfig(near=0.5), 0)
    for number in range(2):
        percept.see(0.05 * number, LINK, ITEM, HAND)
    return percept


def test_near_the_gripper_wrong_middles_do_not_move_the_object() -> None:
    teller = Teller()
    percept = near_percept(teller)
    for number in range(2, 30):
        teller.middle = MIDDLE + 0.02
        percept.see(0.05 * number, LINK, ITEM, HAND)
    np.testing.assert_allclose(percept.object_pose[:3], MIDDLE, atol=1e-3)


def test_near_the_gripper_it_moves_with_its_surface() -> None:
    percept = near_percept(Teller())
    for number in range(2, 8):
        percept.see(0.05 * number, LINK, ITEM + np.array([0.005, 0.0, 0.003]) * (number - 1), HAND)
    moved = compose_point(LINK, np.array([0.03, 0.0, 0.018])) - LINK[:3]
    np.testing.assert_allclose(percept.object_pose[:3], MIDDLE + moved, atol=3e-3)


def test_what_is_followed_far_beside_what_is_told_is_given_up() -> None:
    teller = Teller()
    percept = near_percept(teller)
    percept.choose(percept.grasps[0])
    assert percept.follows
    teller.middle = MIDDLE + 0.08
    percept.see(0.1, LINK, ITEM, HAND)
    assert not percept.follows
    np.testing.assert_allclose(percept.object_pose[:3], teller.middle, atol=1e-9)


def test_what_was_out_of_sight_is_seen_anew() -> None:
    teller = Teller()
    percept = near_percept(teller)
    percept.choose(percept.grasps[0])
    percept.see(0.1, LINK, ITEM[:3], HAND)
    assert percept.follows
    assert percept.unseen(0.1) == pytest.approx(0.05)
    teller.middle = MIDDLE + 0.3
    percept.see(0.4, LINK, ITEM, HAND)
    assert not percept.follows
    assert percept.unseen(0.4) == 0.0
    np.testing.assert_allclose(percept.object_pose[:3], teller.middle, atol=1e-9)
    np.testing.assert_allclose(percept.velocity, 0.0)
