"""Every constant of the reactive receiver (m, rad, s)."""

from dataclasses import dataclass, field, replace

from handover_marl.errors import OptionError
from handover_marl.planning.arm_servo import ServoConfig
from handover_marl.planning.offer_prediction import OfferConfig
from handover_marl.planning.separation import SeparationConfig
from handover_marl.receivers.reactive.displaced import Displacements
from handover_marl.receivers.reactive.grasps import GraspTrials


@dataclass(frozen=True)
class GraspCosts:
    """Which grasp it goes for; prices are in seconds, as the time to a standoff is.

    Attributes:
        candidates: So many grasps at most are looked at closely.
        turn: Price of a turn of the hand from where it waits (s/rad).
        room: Room beside the person's hand that is wanted (m), and
        lack: price of each metre that is missing (s/m).
        least_room: Grasps with less room are not taken, but
        patience: for each second in which there is none this gives way by so much (m/s), and
        bare_room: not below this (m), and
        search: by this share of it while there are some out of reach.
        waiting: After so long without one, or with one that costs more than
        poor: this for how it holds, displaced grasps are looked at, too (s), at
        untried: this price, and
        wider: so many times as many at once.
        table: Room above the table that a gripper needs.
        arm_room: Room that forearm and wrist need beside hand and object.
        way_room: Room that arm and gripper need on the straight way to a standoff (m), and
        blocked: price of a way that has less.
        looks: So many ways at most are looked at in a decision, and
        detours: so many round what is in the way.
        limit: Distance to a joint limit that is wanted (rad), and
        tight: price of each radian that is missing (s/rad).
        longest_way: Joints change less than this between standoff and grasp.
        unstable: Price of a grasp that did not hold when it was tried, and
        shaky: of one that held by the edges of the pads twice of what it costs (see `TriedGrasps`).
        tips: Price of one that has the object by the very tip or edge of a finger, falling to none where it is
        inside: so far from them (m).
        bare_inside: Displaced grasps have it at least so far from them (m).
        failed: Price of a grasp that failed in this episode.
        gain: A grasp is given up only for one that is cheaper by so much, and
        near_gain: by so much more where the gripper is before it already.
    """

    candidates: int = 32
    turn: float = 0.5
    room: float = 0.045
    lack: float = 40.0
    least_room: float = 0.008
    patience: float = 0.01
    bare_room: float = 0.002
    search: float = 0.3
    waiting: float = 0.5
    poor: float = 1.5
    untried: float = 1.5
    wider: int = 4
    table: float = 0.005
    arm_room: float = 0.005
    way_room: float = 0.01
    blocked: float = 2.0
    looks: int = 6
    detours: int = 24
    limit: float = 0.3
    tight: float = 2.0
    longest_way: float = 0.8
    unstable: float = 5.0
    shaky: float = 2.0
    tips: float = 4.0
    inside: float = 0.008
    bare_inside: float = 0.004
    failed: float = 10.0
    gain: float = 0.3
    near_gain: float = 0.5


@dataclass(frozen=True)
class ApproachConfig:
    """From the standoff on, and closing.

    Attributes:
        standoff: Distance before the grasp at which it waits for the object to rest.
        near: From so far before the standoff on it moves in a straight line with the object, if it is
        beside: no farther aside (or than `fixed_beside`, if it is nearer than `fixed`), and
        turned: no more turned than this.
        fixed: Nearer than this to the grasp it stays with it, if it is
        fixed_beside: no farther aside, and
        fixed_turned: no more turned.
        within: No farther aside, half of `fixed` before the grasp, it has the object between its fingers: it does not
            go back to turn or to wait.
        lateral: Aside from the axis it may be at the grasp, and
        funnel: per metre before it.
        turn: It must be turned as the grasp up to this, and
        turn_funnel: per metre before it.
        speed: Along the axis (m/s), with
        braking: this deceleration before the grasp (m/s^2).
        gain: What is left of the way is made up so fast (1/s), while
        joint_speed: no joint is faster than this (rad/s) but for following the object.
        drawn: So far at most its joints are drawn to the chosen ones in a decision (rad).
        object_speed: An object faster than this is not closed in on (m/s), but for one that hovers,
        hover_speed: up to this (m/s).
        close_speed: Fingers close only on an object slower than this, or, if it hovers, that moves beside them slower
            than this (m/s).
        close_axial: They close this near to the grasp, along its axis.
        hover_loose: These two and `lateral` times so much for one that hovers.
        close_time: How long it waits for the person to let go.
        close_period: Time between decisions meanwhile, in which
        close_gain: it follows the person's hand so fast (1/s), with
        close_acceleration: changes of joint speeds like this at most (rad/s^2): a gripper that still moves as it closes
            pushes the object.
        empty: Fingers nearer to each other than twice this hold nothing,
        empty_after: so long after they began to close.
        backing: How far it backs out after a miss, with
        backing_speed: this speed (m/s), for
        backing_time: this long at most, after
        opening_time: this.
        ban: A grasp that failed is not tried again for this time.
        stall: One that has come no nearer for this time is given up.
    """

    standoff: float = 0.08
    near: float = 0.05
    beside: float = 0.06
    turned: float = 0.5
    fixed: float = 0.06
    fixed_beside: float = 0.03
    fixed_turned: float = 0.3
    within: float = 0.015
    lateral: float = 0.005
    funnel: float = 0.3
    turn: float = 0.12
    turn_funnel: float = 1.0
    speed: float = 0.45
    braking: float = 2.0
    gain: float = 20.0
    joint_speed: float = 1.3
    drawn: float = 0.05
    object_speed: float = 0.2
    hover_speed: float = 0.6
    close_speed: float = 0.08
    close_axial: float = 0.006
    hover_loose: float = 2.0
    close_time: float = 0.8
    close_period: float = 0.01
    close_gain: float = 10.0
    close_acceleration: float = 100.0
    empty: float = 0.0015
    empty_after: float = 0.35
    backing: float = 0.1
    backing_speed: float = 0.3
    backing_time: float = 1.0
    opening_time: float = 0.1
    ban: float = 4.0
    stall: float = 0.8


@dataclass(frozen=True)
class RetreatConfig:
    """Taking the object away.

    Attributes:
        back: Way straight back out of the person's hand, on which it turns to the goal.
        speed: Of the gripper on it (m/s).
        acceleration: Of the gripper on it (m/s^2).
        back_time: On it for so long at most: it need not lead to the goal (s).
        turn_gain: How fast the gripper's turning is undone on it (1/s), and
        turn_weight: how much that counts (m/rad).
        inside: How far from the goal it may stop.
        room: Ways that pass the person's hand with so much room, or with what there is at first, are preferred (m).
        looks: So many ends of the way are looked at, whether the way is free.
        stall: If it comes no nearer for this time it takes another end,
        other: with joints that differ by this (rad).
        progress: Nearer is, if no more than this share of the way is left.
        there: Joints so near to the end are there (rad).
    """

    back: float = 0.05
    speed: float = 0.8
    acceleration: float = 6.0
    back_time: float = 0.4
    turn_gain: float = 2.0
    turn_weight: float = 0.1
    inside: float = 0.12
    room: float = 0.02
    looks: int = 40
    stall: float = 0.6
    other: float = 0.5
    progress: float = 0.95
    there: float = 0.05


@dataclass(frozen=True)
class ReactiveConfig:
    """All of it.

    Attributes:
        period: Time between decisions, and
        near_period: where the object is nearer than
        near: this and it or the person's hand is faster than
        near_speed: this (m/s).
        lifted: An object so far from where it lay is being handed over.
        settled: One that is slow for so long rests.
        still: One that lies still for so long beside a hand is handed over, too,
        beside: if a joint of the hand is this near to its origin, and
        after: so late in the episode.
        alone: Without a hand it is from this time on.
        limit_padding: Joint limits are narrowed by so much on each side (rad).
        surface: So many balls stand for the object,
        surface_radius: of this radius, and where it matters
        points: so many points, besides its corners.
    """

    period: float = 0.05
    near_period: float = 0.02
    near: float = 0.3
    near_speed: float = 0.1
    lifted: float = 0.04
    settled: float = 0.2
    still: float = 0.6
    beside: float = 0.15
    after: float = 1.5
    alone: float = 3.0
    limit_padding: float = 0.03
    surface: int = 200
    surface_radius: float = 0.01
    points: int = 5000
    grasps: GraspCosts = GraspCosts()
    displacements: Displacements = field(default_factory=Displacements)
    trials: GraspTrials = field(default_factory=GraspTrials)
    approach: ApproachConfig = ApproachConfig()
    retreat: RetreatConfig = RetreatConfig()
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    offer: OfferConfig = field(default_factory=OfferConfig)
    servo: ServoConfig = field(default_factory=ServoConfig)


def with_risk(config: ReactiveConfig, risk: float) -> ReactiveConfig:
    """The constants for another trade of success against speed.

    Args:
        config: Those for a risk of 0.5.
        risk: From 0, which closes in slowly and only on what rests, to 1.

    Raises:
        OptionError: It is no number from 0 to 1.
    """
    if isinstance(risk, bool) or not isinstance(risk, (int, float)) or not 0.0 <= risk <= 1.0:
        raise OptionError(f"risk={risk!r} must be a number from 0 to 1")
    # 1 at the middle, 1/4 and 4 at the ends.
    pace = 4.0 ** (2.0 * risk - 1.0)
    approach, retreat, grasps, separation = config.approach, config.retreat, config.grasps, config.separation
    return replace(
        config,
        approach=replace(
            approach,
            speed=pace * approach.speed,
            object_speed=pace * approach.object_speed,
            close_speed=pace * approach.close_speed,
            hover_speed=pace * approach.hover_speed,
            lateral=approach.lateral * max(1.0, pace) ** 0.5,
            turn=approach.turn * max(1.0, pace) ** 0.5,
        ),
        retreat=replace(retreat, speed=pace * retreat.speed, acceleration=pace * retreat.acceleration),
        separation=replace(separation, time=separation.time / pace, last_time=separation.last_time / pace),
        grasps=replace(grasps, lack=grasps.lack / pace, shaky=grasps.shaky / pace),
    )
