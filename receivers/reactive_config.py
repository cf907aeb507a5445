"""Every constant of the reactive receiver (m, rad, s)."""

from dataclasses import dataclass

from handover_marl.planning.arm_servo import ServoConfig
from handover_marl.planning.offer_prediction import OfferConfig
from handover_marl.receivers.reactive_grasps import GraspTrials


@dataclass(frozen=True)
class GraspCosts:
    """Which grasp it goes for; costs are in seconds.

    Attributes:
        candidates: So many grasps at most are looked at closely.
        turn: Price of a turn of the hand from where it waits (s/rad), and
        way: of a way from there (s/m), for the choice of candidates.
        room: Room beside the person's hand that is wanted (m), and
        lack: price of each metre that is missing (s/m).
        least_room: Grasps with less room are not taken, but
        patience: for each second in which there is none this gives way by so much (m/s).
        unstable: Price of a grasp that did not hold when it was tried (s), and
        shaky: of one that held in no trial but from its very place, shares of it in between.
        table: Room above the table that a gripper needs.
        limit: Distance to a joint limit that is wanted (rad), and
        tight: price of each radian that is missing (s/rad).
        gain: A grasp is given up only for one that is cheaper by so much (s).
    """

    candidates: int = 32
    turn: float = 0.5
    way: float = 0.5
    room: float = 0.045
    lack: float = 40.0
    least_room: float = 0.008
    patience: float = 0.01
    unstable: float = 5.0
    shaky: float = 1.0
    table: float = 0.005
    limit: float = 0.3
    tight: float = 2.0
    gain: float = 0.3


@dataclass(frozen=True)
class ApproachConfig:
    """The last centimetres.

    Attributes:
        standoff: Distance before the grasp at which it waits for the object to rest.
        lateral: Aside from the axis it may be at the grasp, and
        funnel: per metre before it.
        turn: It must be turned as the grasp up to this.
        speed: Along the axis.
        object_speed: An object faster than this is not closed in on.
        close_speed: Fingers close only on an object slower than this.
        close_axial: They close this near to the grasp, along its axis.
        close_time: How long it waits for the person to let go.
        empty: Fingers nearer to each other than twice this hold nothing.
        backing: How far it backs out after a miss.
        pushed: A grasp that failed is not tried again for this time.
        stall: One that has come no nearer for this time is given up.
    """

    standoff: float = 0.10
    lateral: float = 0.005
    funnel: float = 0.3
    turn: float = 0.12
    speed: float = 0.3
    object_speed: float = 0.2
    close_speed: float = 0.08
    close_axial: float = 0.006
    close_time: float = 0.8
    empty: float = 0.0015
    backing: float = 0.1
    pushed: float = 4.0
    stall: float = 0.8


@dataclass(frozen=True)
class RetreatConfig:
    """Taking the object away.

    Attributes:
        back: Way straight back out of the person's hand before it turns to the goal.
        clear: Room beside the hand from which on the goal alone counts.
        speed: Of the gripper (m/s).
        acceleration: Of the gripper (m/s^2).
        inside: It stops this near to the goal.
    """

    back: float = 0.05
    clear: float = 0.08
    speed: float = 0.8
    acceleration: float = 4.0
    inside: float = 0.1


@dataclass(frozen=True)
class SeparationConfig:
    """Keeping clear of the person's hand: the nearer, the slower (the idea of speed and separation monitoring in
    ISO/TS 15066).

    Attributes:
        stop: Room below which the gripper does not come nearer, while it does not close in on a grasp.
        touch: The same while it does.
        object_stop: Room that it keeps from the object on its way to a standoff.
        time: Time in which the remaining room would be used up at the speed allowed (s).
    """

    stop: float = 0.03
    touch: float = 0.004
    time: float = 0.15
    object_stop: float = 0.015


@dataclass(frozen=True)
class ReactiveConfig:
    """All of it.

    Attributes:
        period: Time between decisions.
        lifted: An object so far from where it lay is being handed over.
        still: One that lies still for so long beside a hand is, too.
        beside: Distance of a hand joint to the object's origin that counts as beside.
    """

    period: float = 0.05
    lifted: float = 0.04
    still: float = 0.6
    beside: float = 0.15
    grasps: GraspCosts = GraspCosts()
    approach: ApproachConfig = ApproachConfig()
    retreat: RetreatConfig = RetreatConfig()
    separation: SeparationConfig = SeparationConfig()
    offer: OfferConfig = OfferConfig()
    servo: ServoConfig = ServoConfig()
    trials: GraspTrials = GraspTrials()
