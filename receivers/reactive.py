"""A receiver that moves with the person: it follows the object, chooses and changes its grasp, and keeps clear.

Knows the true poses of object and hand.
"""

import itertools
from enum import Enum, auto

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import ARM_JOINTS, TIME_STEP
from handover_marl.episode.observations import Observation
from handover_marl.models.arm import Arm
from handover_marl.models.kinematic_tree import read_tree
from handover_marl.models.meshes import model_triangles
from handover_marl.models.panda import CLOSED, HALF_TURN, LOWER_LIMITS, OPEN, UPPER_LIMITS, WAITING_JOINTS
from handover_marl.models.poses import compose, compose_point, inverse, poses_from_rotations, rotate, rotation_angle
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.planning.arm_servo import ArmServo
from handover_marl.planning.capsules import hand_capsules
from handover_marl.planning.gripper_room import Balls, balls_of, corners, nearest, rooms, surface_balls
from handover_marl.planning.inverse_kinematics import solve
from handover_marl.planning.offer_prediction import OfferPrediction
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.policies.receiver import Receiver
from handover_marl.policies.waiting import wait_ms
from handover_marl.receivers.object_grasps import ObjectGrasps
from handover_marl.receivers.reactive_grasps import TriedGrasps, tried_grasps
from handover_marl.receivers.reactive_config import ReactiveConfig

Array = npt.NDArray[np.float64]

_HOME = np.array(WAITING_JOINTS[:ARM_JOINTS])
# Where searches for joints start.
_SEEDS = np.array([_HOME, (-0.386, 0.559, 0.048, -2.175, -1.173, 1.994, 0.797), (0.276, 0.693, 0.397, -2.782, 1.358, 2.557, -0.02)])
_MORE_SEEDS = np.array(
    [
        (0.641, -1.612, -0.197, -2.53, -0.095, 1.678, 0.587),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 1.678, -0.913),
        (-0.059, -1.612, -1.097, -2.53, -0.095, 1.678, 0.587),
        (0.7, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785),
        (-0.059, -1.612, -0.197, -2.53, -0.095, 0.878, 0.587),
        (2.0, 0.23, -2.85, -1.69, 0.056, 1.46, -1.27),
    ]
)
_TABLE = 0.92
_DIRECTIONS = np.array([v / np.linalg.norm(v) for v in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(v)])


class Phase(Enum):
    WAIT = auto()
    APPROACH = auto()
    CLOSE = auto()
    BACK = auto()
    RETREAT = auto()


class ReactiveReceiver(Receiver):
    name = "reactive"
    control_period = 0.05

    def __init__(self, context: PolicyContext, wait: float = 0.0, config: ReactiveConfig | None = None) -> None:
        super().__init__(context)
        self.config = config or ReactiveConfig()
        self._wait = wait_ms(wait) / 1000.0
        self._arm = Arm(read_tree(context.panda_urdf))
        pad = 0.03
        self._limits = (np.array(LOWER_LIMITS[:7]) + pad, np.array(UPPER_LIMITS[:7]) - pad)
        self._base = np.array([*context.panda.base_position, *context.panda.base_orientation])
        self._base_inv = inverse(self._base)
        self._turn = Rotation.from_quat(self._base_inv[3:]).as_matrix()
        steps = round(self.config.period / TIME_STEP)
        self._servo = ArmServo(self.config.servo, context.panda.motor.position_gain, steps, TIME_STEP)
        self._grasps = ObjectGrasps(context.grasps)
        self._surfaces: dict[str, Balls] = {}
        self._tried: dict[str, TriedGrasps] = {}
        self.home_pose = self._hand(_HOME)

    @property
    def wait(self) -> float:
        return self._wait

    def reset(self, seed: int | None = None) -> None:
        self._servo.reset()
        self._offer = OfferPrediction(self.config.offer)
        self._phase = Phase.WAIT
        self._table: Array | None = None
        self._chosen = -1
        self._banned: dict[int, float] = {}
        self._keys: Array | None = None
        self._keyv = np.zeros((16, 3))
        self._since = 0.0
        self._page, self._lost = 0, 0.0
        self._left, self._left_at = np.inf, 0.0
        self._note = ""

    def describe(self) -> str:
        return f"{self._phase.name} {self._note}"

    # ---- perception
    def act(self, observation: Observation) -> Action:
        now = round(float(observation["time"][0]), 3)
        self._now = now
        q = observation["robot_joint_position"].astype(np.float64)
        self._fingers, q = q[7:], q[:7]
        obj = observation["object_poses"][0].astype(np.float64)
        self._offer.see(now, obj)
        self._see_hand(observation)
        self._observation = observation
        if self._table is None:
            self._table = self._grasp_table(observation)
        self._object = obj
        hand = self._hand(q)
        self._note = ""
        if now < self._wait:
            return self._go(q, self._servo.towards(q, _HOME), OPEN)
        if self._phase is Phase.WAIT:
            if not self._offering(observation) or len(self._table) == 0:
                return self._go(q, self._servo.towards(q, _HOME), OPEN)
            self._phase = Phase.APPROACH
        if self._phase is Phase.APPROACH:
            if observation["released"][0]:
                pass
            return self._approach(q, hand)
        if self._phase is Phase.CLOSE:
            return self._close(q, hand, bool(observation["released"][0]))
        if self._phase is Phase.BACK:
            return self._back(q, hand)
        return self._retreat(q, hand)

    def _see_hand(self, observation: Observation) -> None:
        capsules = hand_capsules(observation)
        if capsules is None:
            self._balls, self._keys = None, None
            return
        keys = observation["hand_keypoints"].astype(np.float64)
        step = self.config.period
        if self._keys is not None:
            self._keyv = 0.4 * self._keyv + 0.6 * (keys - self._keys) / step
        else:
            self._keyv = np.zeros((16, 3))
        self._keys = keys
        balls = balls_of(capsules, 3)
        # The wrist is wider than its capsules.
        across = keys[1] - keys[7]
        across = across / max(float(np.linalg.norm(across)), 1e-6)
        extra = np.stack([keys[0] + 0.02 * across, keys[0] - 0.02 * across, keys[0]])
        self._balls = Balls(np.concatenate([balls.centers, extra]), np.concatenate([balls.radii, np.full(3, 0.016)]))

    def _offering(self, observation: Observation) -> bool:
        if self._balls is None:
            return self._now > 3.0
        if self._offer.lifted > self.config.lifted:
            return True
        near = float(np.linalg.norm(self._keys - self._object[:3], axis=1).min()) < self.config.beside
        hand_still = float(np.abs(self._keyv[0]).max()) < 0.05
        return near and hand_still and self._offer.rest > self.config.still and self._now > 1.5

    def _grasp_table(self, observation: Observation) -> Array:
        name = CLASS_NAMES[int(observation["object_classes"][0])]
        if name not in self._surfaces:
            triangles = model_triangles(self.context.object_urdf(name))
            self._surfaces[name] = surface_balls(*triangles, 80, 0.01)
        self._surface = self._surfaces[name]
        found = self._grasps.in_object(name)
        if found is None:
            return np.zeros((0, 7))
        if name not in self._tried:
            self._tried[name] = tried_grasps(self.context.object_urdf(name), found, self.config.trials)
        tried = self._tried[name]
        self._holds = np.concatenate([tried.holds, tried.holds])
        return np.concatenate([tried.poses, compose(tried.poses, np.array(HALF_TURN))])

    # ---- kinematics
    def _hand(self, q: Array) -> Array:
        chain = self._arm.chain(q[None])
        pose = poses_from_rotations(chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0))
        return compose(self._base, pose)[0]

    def _solve(self, poses: Array, seeds: Array, iterations: int, tolerance: float = 1e-3) -> tuple[Array, Array]:
        local = compose(self._base_inv, poses)
        return solve(
            self._arm, local[:, :3], Rotation.from_quat(local[:, 3:]).as_matrix(), seeds, self._limits, tolerance, iterations
        )

    def _go(self, q: Array, velocity: Array, fingers: float) -> Action:
        target = self._servo.command(q, self._servo.limited(velocity))
        return np.array([*target, fingers, fingers], dtype=np.float32)

    def _damped(self, q: Array, hand: Array, velocity: Array, stop: float, transit: bool = False) -> Array:
        """Velocity that does not use up the room to the person's hand too fast."""
        chain = self._arm.chain(q[None])
        jacobian = self._arm.jacobian(chain)[..., 0]
        bodies = []
        if transit:
            here = Balls(compose_point(self._object, self._surface.centers), self._surface.radii)
            bodies.append((here, self.config.separation.object_stop, self._offer.velocity))
        if self._balls is not None:
            bodies.append((self._balls, stop, self._keyv.mean(axis=0)))
        for balls, least_room, moving in bodies:
            near = nearest(hand, balls)
            away = self._turn @ near.away
            row = away @ jacobian[:3] + np.cross(self._turn @ (near.point - hand[:3]), away) @ jacobian[3:]
            rate = row @ velocity - float(near.away @ moving)
            least = min((least_room - near.room) / self.config.separation.time, 0.3)
            if rate < least:
                velocity = velocity + row * (least - rate) / (row @ row + 1e-4)
        return velocity

    # ---- choice
    def _choose(self, q: Array, hand: Array, pose: Array) -> Array | None:
        """Sets the chosen grasp; returns its standoff joints."""
        costs = self.config.grasps
        table = self._table
        world = compose(pose, table)
        room = np.full(len(table), 0.2)
        if self._balls is not None:
            inv = inverse(self._object)
            local = Balls(rotate(inv[3:], self._balls.centers) + inv[:3], self._balls.radii)
            room = rooms(table, local, 0.08)
        turns = (Rotation.from_quat(self.home_pose[3:]).inv() * Rotation.from_quat(world[:, 3:])).magnitude()
        rough = costs.turn * turns + costs.lack * np.maximum(0.0, costs.room - room)
        rough += costs.unstable * (self._holds == 0.0) + costs.shaky * (1.0 - self._holds)
        rough[room < costs.least_room - costs.patience * self._lost] += 100.0
        backed = compose(world, np.array([0, 0, -self.config.approach.standoff, 0, 0, 0, 1.0]))
        lowest = np.minimum(corners(world)[..., 2].min(axis=1), corners(backed)[..., 2].min(axis=1))
        rough[lowest < _TABLE + costs.table] += 100.0
        for number, until in self._banned.items():
            if self._now < until:
                rough[number] += 10.0
        order = np.argsort(rough, kind="stable")
        order = np.roll(order[rough[order] < 50.0], -self._page * costs.candidates)[: costs.candidates]
        if len(order) == 0:
            self._note = f"no room={room.max():.3f}"
            self._lost += self.config.period * (self._offer.rest > 0.2)
            self._chosen = -1
            return None
        if self._chosen >= 0 and self._chosen not in order:
            order = np.append(order, self._chosen)
        standoffs = compose(world[order], np.array([0, 0, -self.config.approach.standoff, 0, 0, 0, 1.0]))
        n = len(order)
        base = np.concatenate([_SEEDS, _MORE_SEEDS]) if self._page else _SEEDS
        seeds = np.repeat(base, n, axis=0)
        count = len(base)
        qs, ok = self._solve(np.tile(standoffs, (count, 1)), seeds, 12)
        qg, ok2 = self._solve(np.tile(world[order], (count, 1)), qs, 6)
        ok &= ok2 & (np.abs(qg - qs).max(axis=1) < 0.8)
        travel = (np.abs(qs - q) / self._servo.limits).max(axis=1)
        which = np.argmin(np.where(ok, travel, np.inf).reshape(count, n), axis=0) * n + np.arange(n)
        qs, qg, ok, travel = qs[which], qg[which], ok[which], travel[which]
        edge = np.minimum(qg - self._limits[0], self._limits[1] - qg).min(axis=1)
        edge = np.minimum(edge, np.minimum(qs - self._limits[0], self._limits[1] - qs).min(axis=1))
        cost = travel + costs.tight * np.maximum(0, costs.limit - edge)
        cost += rough[order]
        cost[~ok] += 1000.0
        best = int(np.argmin(cost))
        if cost[best] > 50.0:
            self._note = f"nothing ok={ok.sum()} room={room.max():.3f}"
            if cost[best] >= 1000.0:
                self._page += 1
                self._lost += self.config.period * (self._offer.rest > 0.2) * 0.3
                self._chosen = -1
                return None
        if self._chosen >= 0 and cost[np.flatnonzero(order == self._chosen)[0]] < 50:
            old = int(np.flatnonzero(order == self._chosen)[0])
            if cost[old] <= cost[best] + costs.gain:
                best = old
        if order[best] != self._chosen:
            self._left, self._left_at = np.inf, self._now
        self._chosen, self._page = int(order[best]), 0
        self._grasp_room = float(room[self._chosen])
        self._joints = qg[best]
        return qs[best]

    # ---- phases
    def _approach(self, q: Array, hand: Array) -> Action:
        config = self.config.approach
        offset = None
        locked = False
        if self._chosen >= 0:
            offset = self._offset(hand, self._object)
            axial, lateral, angle = offset
            locked = axial < 0.06 and lateral < 0.03 and angle < 0.3
        if not locked:
            standoff = self._choose(q, hand, self._offer.offered())
            if standoff is None:
                return self._go(q, self._damped(q, hand, self._servo.towards(q, _HOME), self.config.separation.stop), OPEN)
        axial, lateral, angle = self._offset(hand, self._object)
        speed = self._offer.speed
        near = axial < config.standoff + 0.05 and lateral < 0.06 and angle < 0.5
        self._note += f" g{self._chosen} room={self._grasp_room:.3f} ax={axial:.3f} lat={lateral:.3f} ang={angle:.2f} v={speed:.2f}"
        if not near:
            velocity = self._servo.towards(q, standoff)
            velocity = self._servo.limited(velocity)
            self._stalled(float(np.abs(standoff - q).max()))
            return self._go(q, self._damped(q, hand, velocity, self.config.separation.stop, True), OPEN)
        self._stalled(axial + lateral)
        # closed loop relative to the moving object
        if axial < config.close_axial and lateral < config.lateral and angle < config.turn and speed < config.close_speed:
            self._phase, self._since = Phase.CLOSE, self._now
            self._close_pose = compose(self._object, self._table[self._chosen])
            return self._close(q, hand, False)
        ok = lateral < config.lateral + config.funnel * max(axial, 0.0) and angle < config.turn + axial
        if speed < config.object_speed and ok:
            depth = max(0.0, axial - config.speed * self.config.period)
        elif ok and axial < config.standoff:
            depth = max(axial, 0.0) if speed < 2 * config.object_speed else config.standoff
        else:
            depth = config.standoff if axial > 0.03 else axial
        pose = compose(self._offer.soon(self.config.period), self._table[self._chosen])
        pose = compose(pose, np.array([0, 0, -depth, 0, 0, 0, 1.0]))
        goal, okay = self._solve(pose[None], q[None], 8)
        velocity = (goal[0] - q) / self.config.period
        velocity = self._servo.limited(velocity)
        stop = min(self.config.separation.stop, max(self._grasp_room - 0.015, 0.001))
        return self._go(q, self._damped(q, hand, velocity, stop), OPEN)

    def _stalled(self, left: float) -> None:
        """Gives a grasp up that does not come nearer."""
        if left < 0.95 * self._left or self._offer.rest < 0.2:
            self._left, self._left_at = left, self._now
        elif self._now - self._left_at > self.config.approach.stall:
            self._banned[self._chosen] = self._now + self.config.approach.pushed
            self._chosen, self._left = -1, np.inf

    def _offset(self, hand: Array, pose: Array) -> tuple[float, float, float]:
        grasp = compose(pose, self._table[self._chosen])
        local = compose(inverse(grasp), hand)
        return -float(local[2]), float(np.hypot(local[0], local[1])), rotation_angle(grasp[3:], hand[3:])

    def _close(self, q: Array, hand: Array, released: bool) -> Action:
        config = self.config.approach
        if released:
            self._phase = Phase.RETREAT
            self._release_pose = hand.copy()
            self._speed, self._share, self._goal_joints = 0.0, 0.0, None
            self._stuck: list[Array] = []
            return self._retreat(q, hand)
        self._note = f"fingers={self._fingers[0]:.4f} {self._fingers[1]:.4f}"
        since = self._now - self._since
        empty = since > 0.3 and self._fingers.max() < config.empty
        if empty or since > config.close_time:
            self._banned[self._chosen] = self._now + config.pushed
            self._phase, self._since = Phase.BACK, self._now
            self._back_pose = compose(hand, np.array([0, 0, -config.backing, 0, 0, 0, 1.0]))
            return self._back(q, hand)
        if self._balls is not None:
            self._close_pose[:3] += self._keyv.mean(axis=0) * self.config.period
        goal, okay = self._solve(self._close_pose[None], q[None], 6)
        return self._go(q, 0.5*(goal[0] - q) / self.config.period, CLOSED)

    def _back(self, q: Array, hand: Array) -> Action:
        if float(np.linalg.norm(hand[:3] - self._back_pose[:3])) < 0.03 or self._now - self._since > 1.0:
            self._phase = Phase.APPROACH
            self._chosen = -1
            return self._approach(q, hand)
        # fingers first
        velocity = np.zeros(7)
        if self._now - self._since > 0.1:
            way = self._back_pose[:3] - hand[:3]
            velocity = self._cartesian(q, 0.25 * way / max(np.linalg.norm(way), 1e-6), np.zeros(3))
        return self._go(q, velocity, OPEN)

    def _cartesian(self, q: Array, linear: Array, angular: Array, weight: float = 0.3) -> Array:
        chain = self._arm.chain(q[None])
        J = self._arm.jacobian(chain)[..., 0]
        x = np.concatenate([self._turn @ linear, self._turn @ angular])
        W = np.array([1, 1, 1, weight, weight, weight])[:, None]
        free = np.ones(7, dtype=bool)
        low, high = self._limits
        velocity = np.zeros(7)
        for _ in range(4):
            A = W * J * free
            velocity = A.T @ np.linalg.solve(A @ A.T + 1e-3 * np.eye(6), W[:, 0] * x)
            soon = q + velocity * self.config.period
            bad = free & (((soon < low) & (velocity < 0)) | ((soon > high) & (velocity > 0)))
            if not bad.any():
                break
            free &= ~bad
        return velocity * free

    def _carry_goal(self, q: Array, hand: Array) -> Array:
        """Joints near the goal that are soonest reached."""
        goal = np.array(self.context.protocol.goal_center)
        home = Rotation.from_quat(self.home_pose[3:])
        here = Rotation.from_quat(hand[3:])
        ways = np.concatenate([np.zeros((1, 3)), self.config.retreat.inside * _DIRECTIONS])
        turn = (home * here.inv()).as_rotvec()
        turns = [(Rotation.from_rotvec(share * turn) * here).as_quat() for share in (0.0, 0.25, 0.5, 1.0)]
        poses = np.array([[*(goal + way), *quat] for way in ways for quat in turns])
        count = len(poses)
        seeds = np.concatenate([np.repeat(q[None], count, axis=0), np.repeat(_SEEDS, count, axis=0)])
        joints, ok = self._solve(np.tile(poses, (1 + len(_SEEDS), 1)), seeds, 12, 5e-3)
        travel = (np.abs(joints - q) / self._servo.limits).max(axis=1)
        travel[~ok] += 100.0
        for other in self._stuck:
            travel[np.abs(joints - other).max(axis=1) < 0.5] += 20.0
        held = compose_point(compose(inverse(hand), self._object), self._surface.centers)
        order = np.argsort(travel, kind="stable")
        for number in order[:40]:
            if travel[number] < 50.0 and self._way_free(q, joints[number], held):
                return joints[number]
        return joints[order[0]]

    def _way_free(self, q: Array, goal: Array, held: Array) -> bool:
        """Whether gripper and held object keep clear of the arm itself on the straight joint way."""
        line = q + np.array([0.35, 0.7, 1.0])[:, None] * (goal - q)
        chain = self._arm.chain(line)
        hands = poses_from_rotations(chain.origins[-1].T, np.moveaxis(chain.rotations[-1], -1, 0))
        for number, hand in enumerate(hands):
            shoulder, elbow, wrist = chain.origins[1, :, number], chain.origins[3, :, number], chain.origins[4, :, number]
            ends = np.array([np.zeros(3), shoulder, elbow, wrist])
            shares = np.linspace(0.0, 1.0, 6)[:, None, None]
            centers = (ends[:-1] + shares * (ends[1:] - ends[:-1])).reshape(-1, 3)
            radii = np.tile([0.1, 0.09, 0.075], 6)
            body = centers @ Rotation.from_quat(hand[3:]).as_matrix() - Rotation.from_quat(hand[3:]).inv().apply(hand[:3])
            if _gripper_near(body, radii) or (np.linalg.norm(held[:, None] - body, axis=-1) - radii).min() < 0.0:
                return False
        return True

    def _retreat(self, q: Array, hand: Array) -> Action:
        config = self.config.retreat
        if self._goal_joints is None:
            self._goal_joints = self._carry_goal(q, hand)
            self._left, self._left_at = np.inf, self._now
        left = float(np.abs(q - self._goal_joints).max())
        if left < 0.95 * self._left:
            self._left, self._left_at = left, self._now
        elif self._now - self._left_at > self.config.approach.stall and left > 0.05:
            self._stuck.append(self._goal_joints)
            self._goal_joints, self._left = None, np.inf
            return self._retreat(q, hand)
        room = 1.0 if self._balls is None else nearest(hand, self._balls).room
        axis = rotate(self._release_pose[3:], np.array([0, 0, 1.0]))
        backed = -float((hand[:3] - self._release_pose[:3]) @ axis)
        share = float(np.clip(backed / config.back, self._share, 1.0))
        self._share = share
        self._speed = min(config.speed, self._speed + config.acceleration * self.config.period)
        turn = (Rotation.from_quat(self._release_pose[3:]) * Rotation.from_quat(hand[3:]).inv()).as_rotvec()
        velocity = np.zeros(7)
        if share < 1.0:
            velocity = (1.0 - share) * self._cartesian(q, -self._speed * axis, 2.0 * turn, 0.1)
        velocity = velocity + share * self._servo.limited(self._servo.towards(q, self._goal_joints))
        velocity = self._servo.limited(velocity)
        self._note = f"room={room:.3f} back={backed:.3f} fingers={self._fingers[0]:.4f} joints={np.abs(q - self._goal_joints).max():.2f}"
        return self._go(q, self._damped(q, hand, velocity, min(self.config.separation.stop, room)), CLOSED)


def _gripper_near(centers: Array, radii: Array) -> bool:
    """Whether balls in the hand's frame touch its body or fingers."""
    pose = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    return bool(rooms(pose, Balls(centers[:], radii), flange=False)[0] < 0.0)
