"""What the vision receiver makes of points: grasps with qualities, and how object and hand move."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.models.panda import HALF_TURN
from handover_marl.models.poses import compose, compose_point
from handover_marl.planning.gripper_room import Balls
from handover_marl.receivers.reactive.displaced import displacement
from handover_marl.receivers.vision.finger_room import Fingers, passing
from handover_marl.receivers.vision.object_track import KeyView, SeenBody, Track, Trust

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Told:
    """What a network tells of one view, in the hand link's frame.

    Attributes:
        grasps: (C, 7) poses of the hand link at grasps.
        quality: (C,) how good they are, 0 to 1.
        middle: (3,) of the object (m).
    """

    grasps: Array
    quality: Array
    middle: Array


#: From points of the object (n, 3) and of the hand (m, 3) in the hand link's frame (m), the object's velocity (3,)
#: in it (m/s), and a generator, to what is told.
GraspFunction = Callable[[Array, Array, Array, np.random.Generator], Told]


@dataclass(frozen=True)
class PerceptConfig:
    """How views become grasps to choose from.

    Attributes:
        least: Fewer points of the object are no view of it.
        most: So many grasps at most are offered.
        worth: Grasps below this quality are not, and
        scale: a grasp of quality 1/e has this price (s).
        tilts: Where none of these helps, all are, and copies turned about the line between the pads (rad), at
        tilted: this price (s).
        pads: Distance of that line from the hand link (m).
        fingers: How grasps are moved aside whose fingers would hit what is seen of the object, of which
        looked_at: so many points are looked at.
        same: Grasps nearer than this are the same (m), with a turn counted by
        arm: this (m/rad).
        fading: Price (s) that the chosen grasp gains at each look that does not show it.
        failed: Price of grasps that are the same as one that failed (s).
        far: How far a look is trusted,
        close: with the object nearer to the gripper than `near`, and
        last: with the chosen grasp nearer than this (m):
        blind: that far.
        reach: Points of the object move less than this between two looks (m).
        known: Looks of which less than this share is part of an earlier one cannot be matched with it, and
        renewed: less than this is matched, and what comes with it.
        strayed: What is followed so far beside the middle that is told (m) is not the object.
        resting: Slower than this it is taken to rest (m/s).
        slowing: What is not seen is taken to lose this share of its velocity at each look, and
        lost: after so long (s) nothing is left of what was known of it.
        ball: Radius of the balls that stand for what was seen of object and hand (m), one for each cube of side
        cube: this (m), and
        memory: for how long (s), the hand;
        latest: the object, which turns as it is lifted; but for
        near: an object this near to the gripper (m), which hides the hand: nothing is forgotten then.
    """

    least: int = 20
    most: int = 48
    worth: float = 0.02
    scale: float = 3.0
    tilts: tuple[float, ...] = (-0.35, 0.35, -0.7, 0.7)
    tilted: float = 1.5
    pads: float = 0.1
    fingers: Fingers = field(default_factory=Fingers)
    looked_at: int = 400
    same: float = 0.03
    arm: float = 0.06
    fading: float = 0.1
    failed: float = 10.0
    far: Trust = field(default_factory=lambda: Trust(0.5, 0.1, 0.4))
    close: Trust = field(default_factory=lambda: Trust(0.9, 0.1, 0.1))
    last: float = 0.07
    blind: Trust = field(default_factory=lambda: Trust(0.9, 0.1, 0.02))
    reach: float = 0.03
    known: float = 0.3
    renewed: float = 0.6
    strayed: float = 0.05
    resting: float = 0.04
    slowing: float = 0.4
    lost: float = 0.12
    ball: float = 0.01
    cube: float = 0.012
    memory: float = 1.5
    latest: float = 0.4
    near: float = 0.3


class Percept:
    """Follows one episode.

    Args:
        tells: The network.
        config: How.

    Attributes:
        seen: Whether the object was ever seen.
        grasps: (n, 7) poses of the hand link relative to the object's middle, the chosen one first if there is one.
        prices: (n,) how poor they are (s).
        surface: The seen part of the object, relative to its middle.
        hand: The seen part of the person's hand in the world, or None.
        wider: Whether all grasps that are told are offered, and tilted copies of them.
    """

    def __init__(self, tells: GraspFunction, config: PerceptConfig, seed: int | None) -> None:
        self._tells, self._config = tells, config
        self._rng = np.random.default_rng(0 if seed is None else seed)
        self.grasps, self.prices = np.zeros((0, 7)), np.zeros(0)
        self._seen_at = -np.inf
        self._chosen: Array | None = None
        self._key: KeyView | None = None
        self._start_anew()
        self.surface = Balls(np.zeros((1, 3)), np.zeros(1))
        self.hand: Balls | None = None
        self.wider = False
        self._chosen_price = 0.0
        self._failed: list[tuple[Array, float]] = []

    @property
    def seen(self) -> bool:
        """Whether the object was ever seen."""
        return self.object.place is not None

    @property
    def follows(self) -> bool:
        """Whether it still knows where the grasp is that it was told to follow."""
        return self._chosen is not None

    def unseen(self, time: float) -> float:
        """For how long (s) the object was not seen; infinite before it ever was."""
        return time - self._seen_at

    @property
    def object_pose(self) -> Array:
        """(7,) where the object's middle is, not turned."""
        place = np.zeros(3) if self.object.place is None else self.object.place
        return np.array([*place, 0.0, 0.0, 0.0, 1.0])

    def see(self, time: float, link: Array, item: Array, hand: Array) -> None:
        """Take note of points of object (n, 3) and hand (m, 3) in the frame of the hand link at (7,)."""
        config = self._config
        if len(item) < config.least:
            self.object.coast(time)
            self._remember(time, link, item, hand)
            self._offer(np.zeros((0, 7)), np.zeros(0), time, config.far)
            return
        if self.unseen(time) > config.lost:
            self._start_anew()
        self._seen_at = time
        told = self._tells(item, hand, Rotation.from_quat(link[3:]).inv().apply(self.object.velocity), self._rng)
        trust = self._trust(link)
        self._follow(time, link, item, told, trust)
        middle = self.object_pose[:3]
        self._remember(time, link, item, hand)
        seen = item[:: max(1, len(item) // config.looked_at)]
        order = np.argsort(-told.quality, kind="stable")
        if not self.wider:
            order = order[: config.most]
            order = order[told.quality[order] > config.worth]
        passing_ones, extra = passing(told.grasps[order], seen, config.fingers)
        grasps = compose(link, passing_ones)
        grasps[:, :3] -= middle
        prices = extra - config.scale * np.log(told.quality[order])
        if self.wider and len(grasps):
            ways = [displacement(tilt, 0.0, 0.0, config.pads) for tilt in config.tilts]
            grasps = np.concatenate([grasps, *(compose(grasps, way) for way in ways)])
            prices = np.concatenate([prices, np.tile(prices + config.tilted, len(ways))])
        if self._chosen is not None and trust is not config.blind:
            chosen, extra = passing(self._chosen[None], compose_point(link, seen) - middle, config.fingers)
            self._chosen, self._chosen_price = chosen[0], self._chosen_price + config.fading * float(extra[0])
        self._offer(grasps, prices, time, trust)

    @property
    def velocity(self) -> Array:
        """(3,) of the object and of the hand that holds it (m/s)."""
        moving = float(np.linalg.norm(self.object.velocity)) > self._config.resting
        return self.object.velocity if moving else np.zeros(3)

    def choose(self, grasp: Array | None) -> None:
        """Follow a grasp (7,) relative to the middle from now on; None follows none."""
        self._chosen = grasp

    def fail(self, grasp: Array, until: float) -> None:
        """A grasp (7,) relative to the middle failed, and costs more until a time (s), as half a turn of it does."""
        self._failed += [(grasp, until), (compose(grasp, np.array(HALF_TURN)), until)]

    def _start_anew(self) -> None:
        """Nothing is known of where the object is, nor of what moves with it."""
        config = self._config
        self.object = Track(config.slowing)
        self._item, self._fingers = SeenBody(config.cube, config.latest), SeenBody(config.cube, config.memory)
        self._chosen = None
        self._key = None

    def _near(self, link: Array) -> bool:
        """Whether the object is near the hand link at (7,)."""
        return self.seen and float(np.linalg.norm(self.object_pose[:3] - link[:3])) < self._config.near

    def _follow(self, time: float, link: Array, item: Array, told: Told, trust: Trust) -> None:
        """Take note of where the object is.

        From near the camera sees a part of the object, of which the network can but guess the middle: from there its
        surface tells how it moved.
        """
        config, cloud, middle = self._config, compose_point(link, item), compose_point(link, told.middle)
        share = 0.0
        if trust is config.far:
            self._key = None
        elif self._key is not None:
            expected = self.object.expected(time)
            beside, share = self._key.beside(cloud - expected, config.reach)
            strayed = float(np.linalg.norm(expected + beside - middle)) > config.strayed
            if share < config.known or (strayed and trust is not config.blind):
                # It follows something else.
                self._start_anew()
                share = 0.0
            else:
                middle = expected + beside
        self.object.see(time, middle, trust if share else config.far)
        if trust is not config.far and share < config.renewed:
            self._key = KeyView(cloud - self.object_pose[:3])

    def _trust(self, link: Array) -> Trust:
        """How far a look from the hand link at (7,) is trusted."""
        config = self._config
        if self.seen and self._chosen is not None:
            grasp = self.object_pose[:3] + self._chosen[:3]
            if float(np.linalg.norm(grasp - link[:3])) < config.last:
                return config.blind
        return config.close if self._near(link) else config.far

    def _remember(self, time: float, link: Array, item: Array, hand: Array) -> None:
        """Add what is seen of object and hand to what was."""
        if not self.seen:
            return
        config, middle = self._config, self.object_pose[:3]
        forget = not self._near(link)
        for body, points in ((self._item, item), (self._fingers, hand)):
            body.see(time, compose_point(link, points) - middle, forget)
        self.surface = Balls(self._item.points, np.full(len(self._item.points), config.ball))
        balls = Balls(middle + self._fingers.points, np.full(len(self._fingers.points), config.ball))
        self.hand = balls if len(balls.centers) else None

    def _offer(self, grasps: Array, prices: Array, time: float, trust: Trust) -> None:
        """The grasps of a view, with that chosen before first."""
        both = np.concatenate([grasps, compose(grasps, np.array(HALF_TURN))]) if len(grasps) else grasps
        doubled = np.concatenate([prices, prices])
        if self._chosen is not None:
            self._refresh(both, doubled, trust.renew)
            both, doubled = np.concatenate([self._chosen[None], both]), np.append(self._chosen_price, doubled)
        doubled = doubled.copy()
        self._failed = [(pose, until) for pose, until in self._failed if until > time]
        for pose, _ in self._failed:
            doubled[self._away(pose, both) < self._config.same] += self._config.failed
        self.grasps, self.prices = both, doubled

    def _refresh(self, grasps: Array, prices: Array, renew: float) -> None:
        """Draw the chosen grasp to what is told of it now."""
        config, chosen = self._config, self._chosen
        if chosen is None:
            return
        away = self._away(chosen, grasps)
        near = np.flatnonzero(away < config.same)
        if not len(near):
            self._chosen_price += config.fading
            return
        weights = np.exp(-prices[near] / config.scale - (2.0 * away[near] / config.same) ** 2)
        weights /= weights.sum()
        signs = np.sign(grasps[near, 3:] @ chosen[3:])
        told = np.concatenate([weights @ grasps[near, :3], weights @ (signs[:, None] * grasps[near, 3:])])
        told[3:] *= np.sign(told[3:] @ chosen[3:])
        mixed = (1.0 - renew) * chosen + renew * told
        mixed[3:] /= np.linalg.norm(mixed[3:])
        self._chosen = mixed
        self._chosen_price = (1.0 - renew) * self._chosen_price + renew * float(weights @ prices[near])

    def _away(self, pose: Array, poses: Array) -> Array:
        """(n,) distances (m) of grasps, turns counted; at the pads, where it matters."""
        pads = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
        places = compose(poses, pads)[:, :3] - compose(pose, pads)[:3] if len(poses) else np.zeros((0, 3))
        cosines = np.clip(np.abs(poses[:, 3:] @ pose[3:]), 0.0, 1.0)
        found: Array = np.linalg.norm(places, axis=1) + 2.0 * self._config.arm * np.arccos(cosines)
        return found
