"""Goal sets of the OMG planner (see `planner.py`): arm configurations at grasps, and the selection among them.

Each goal has an approach: the arm configurations on the straight path from the standoff to the grasp.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.geometry.arm import ArmKinematics, LinkFrames, transform_body_points
from handover_marl.geometry.poses import compose
from handover_marl.planning.ik_solvers import solve_ik
from handover_marl.planning.trajectory_cost import Obstacle, ObstacleCost

Array = npt.NDArray[np.float64]
Limits = tuple[Array, Array]

_N_FINGERS = 2
_LAST_JOINT = 6

# The following values are the authors'.
# Arm configurations at which inverse kinematics starts (rad), in addition to the start of the trajectory.
_IK_SEEDS = (
    (2.5, 0.23, -2.89, -1.69, 0.056, 1.46, -1.27),
    (2.8, 0.23, -2.89, -1.69, 0.056, 1.46, -1.27),
    (2.0, 0.23, -2.89, -1.69, 0.056, 1.46, -1.27),
    (2.5, 0.83, -2.89, -1.69, 0.056, 1.46, -1.27),
    (0.049, 1.22, -1.87, -0.67, 2.12, 0.99, -0.85),
    (-2.28, -0.43, 2.47, -1.35, 0.62, 2.28, -0.27),
    (-2.02, -1.29, 2.20, -0.83, 0.22, 1.18, 0.74),
    (-2.2, 0.03, -2.89, -1.69, 0.056, 1.46, -1.27),
    (-2.5, -0.71, -2.73, -0.82, -0.7, 0.62, -0.56),
    (-2.0, -0.71, -2.73, -0.82, -0.7, 0.62, -0.56),
    (-2.66, -0.55, 2.06, -1.77, 0.96, 1.77, -1.35),
    (1.51, -1.48, -1.12, -1.55, -1.57, 1.15, 0.24),
)
# Number of Newton steps of inverse kinematics, and its error in each component of position (m) and rotation vector.
_MAX_ITERATIONS, _TOLERANCE = 100, 1e-6
# Length of `N_APPROACH` steps along the hand's z axis (m); an approach begins at the standoff and has one step less.
_STANDOFF = 0.08
#: Number of poses on the approach from standoff to grasp, both included.
N_APPROACH = 5
# Maximum norm of the joint differences on an approach (rad); on a longer one, inverse kinematics has jumped.
_MAX_APPROACH_NORM = 2.0
# Maximum rotation of the hand from its start (rad), minimum z component of the hand's x axis in the base frame, and
# number of points on the straight joint path to the grasp at which both are checked.
_MAX_ROTATION, _MIN_HAND_X_Z, _N_PATH_CHECKS = np.radians(120.0), -0.3, 5
#: A point of the robot collides with an object if their distance is less than this (m).
COLLISION_DISTANCE = 0.01
# Maximum number of colliding pairs of robot point and object at a standoff.
_MAX_COLLISIONS = 5
# Minimum distance between the standoffs of two goals (rad), and maximum number of goals in a goal set.
_MIN_GOAL_DISTANCE, _MAX_GOALS = 0.5, 100
# Number of selection rounds for which the optimal learning rate is computed, and the experts' multiples of that rate.
_N_ROUNDS, _LEARNING_RATES = 50, (0.25, 0.5, 1.0, 4.0, 16.0)
# Number of waypoints by which the start of the evaluated straight path moves along the trajectory in each round.
_LOOKAHEAD_RATE = 0.6
# Weight of the straight path's squared length in joint space.
_SMOOTHNESS_WEIGHT = 0.003
# Number of last goals that the authors' code never checks for collisions; see `PlannerConfig.unchecked_last`.
_UNCHECKED = 5
#: Minimum clearance of gripper and person's hand (m); if no goal has it, only those with the largest one are kept.
MIN_HAND_CLEARANCE = 0.02


def is_usable_grasp(object_name: str, grasps: Array) -> npt.NDArray[np.bool_]:
    """Return a mask (n,) of the grasps that OMG uses; grasps are hand link poses (n, 7; xyzw) in the object's frame.

    Some grasps of scissors, bowl and mug (YCB class names) slip and are excluded.
    """
    rule = _RULES.get(object_name)
    if rule is None:
        return np.ones(len(grasps), dtype=bool)
    tilts = np.abs(Rotation.from_quat(grasps[:, 3:]).as_euler("xyz")[:, 1])
    return rule(grasps[:, :3], tilts)


def _is_usable_on_scissors(positions: Array, tilts: Array) -> npt.NDArray[np.bool_]:
    x, y, z = np.abs(positions).T
    return np.asarray((z > 0.09) & (y > 0.02) & (x < 0.05) & (tilts > 0.06))


# Rules on positions (n, 3) in m and absolute middle Euler angles (n,) in rad, static xyz axes.
_RULES: dict[str, Callable[[Array, Array], npt.NDArray[np.bool_]]] = {
    "037_scissors": _is_usable_on_scissors,
    "024_bowl": lambda positions, tilts: tilts > np.radians(30.0),
    "025_mug": lambda positions, tilts: tilts > np.radians(15.0),
}


@dataclass(frozen=True, eq=False)
class GoalSet:
    """Set of goals at which a trajectory may end: arm configurations at grasps.

    Attributes:
        approaches: (g, t, 7) configurations on the approach from the standoff to the grasp (rad).
        grasps: (g,) index of each goal's grasp among the grasps that were given to the builder.
        clearances: (g,) smallest clearance of gripper and person's hand on each approach (m), inf without a hand.
    """

    approaches: Array
    grasps: npt.NDArray[np.int_]
    clearances: Array

    def __len__(self) -> int:
        return len(self.approaches)

    @property
    def standoffs(self) -> Array:
        """(g, 7) configurations at the standoffs, where the approaches to the grasps start (rad)."""
        return self.approaches[:, 0]

    @property
    def goals(self) -> Array:
        """(g, 7) configurations at the grasps, where the approaches end (rad)."""
        return self.approaches[:, -1]

    def select(self, selection: npt.NDArray[np.generic]) -> "GoalSet":
        """Return a goal set of some goals, which `selection` gives as indices (k,) or as a mask (g,)."""
        return GoalSet(self.approaches[selection], self.grasps[selection], self.clearances[selection])


class GoalSetBuilder:
    """Builder of goal sets by inverse kinematics, collision checks and removal of near duplicates, in the base frame.

    Args:
        arm: Kinematics of the arm.
        body: (m, 3) points on each link of the arm, in the link's frame (m).
        gripper: (m, 3) points on each link of hand and fingers (m), from which clearances to the person are computed.
        start: (7,) configuration at which motions start (rad).
        limits: Lower and upper joint limits with padding, (7,) each (rad).
        unchecked_last: Whether the last five goals skip the collision check, an error of the authors' code.
    """

    def __init__(
        self,
        arm: ArmKinematics,
        body: Sequence[Array],
        gripper: Sequence[Array],
        start: Array,
        limits: Limits,
        unchecked_last: bool = False,
    ) -> None:
        self._arm, self._body, self._gripper, self._start, self._limits = arm, body, gripper, start, limits
        self._unchecked_last = unchecked_last

    def build(self, grasps: Array, objects: Sequence[Obstacle], person: Obstacle | None) -> GoalSet:
        """Return the goals at which the hand link reaches one of the grasps, poses (n, 7; xyzw) in the base frame.

        Goals are excluded if the hand turns far or tips on the straight joint path to them, if arm or hand link collide
        with `objects` at the standoff, or if the clearance to the person's hand `person` is below 2 cm. If it is below
        for all goals, only the largest is kept. Of goals with standoffs less than 0.5 rad apart, the one with the
        largest clearance is kept. At most 100 goals are returned, in a fixed pseudo-random order.
        """
        goals = self._add_wrist_flips(self._solve_approaches(grasps))
        goals = goals.select(self._keeps_orientation(goals.goals))
        goals = goals.select(self._is_collision_free(goals.standoffs, objects))
        if person is not None and len(goals):
            goals = replace(goals, clearances=self._compute_clearances(goals.approaches, person))
            goals = goals.select(np.argsort(-goals.clearances, kind="stable"))
            least = min(MIN_HAND_CLEARANCE, float(goals.clearances.max()))
            goals = goals.select(goals.clearances >= least)
        return self._remove_similar_goals(goals)

    def _compute_clearances(self, approaches: Array, person: Obstacle) -> Array:
        """Return the smallest distances (g,) in m of gripper and person's hand on each of g approaches (g, t, 7)."""
        frames = self._arm.compute_link_frames(approaches.reshape(-1, approaches.shape[-1]))
        hand = len(frames.origins) - len(self._gripper)
        points = transform_body_points(LinkFrames(frames.origins[hand:], frames.rotations[hand:]), self._gripper)
        distances = person.compute_distances(points.reshape(3, -1).astype(np.float32))
        by_point = distances.reshape(points.shape[1], *approaches.shape[:2])
        return np.asarray(by_point.min(axis=(0, 2)).astype(np.float64))

    def _solve_approaches(self, grasps: Array) -> GoalSet:
        """Return a goal for each pair of a grasp of (n, 7) and an IK seed from which IK solves the whole approach."""
        seeds = np.array([self._start, *_IK_SEEDS])
        numbers = np.repeat(np.arange(len(grasps)), len(seeds))
        joints, solved = self._solve(self._compute_approach_poses(grasps, 0), numbers, np.tile(seeds, (len(grasps), 1)))
        numbers, rows = numbers[solved], [joints[solved]]
        # The grasp is solved from the standoff, then each pose on the way back from the previous.
        for step in (N_APPROACH - 1, *range(N_APPROACH - 2, -1, -1)):
            joints, solved = self._solve(self._compute_approach_poses(grasps, step), numbers, rows[-1])
            numbers, rows = numbers[solved], [*(row[solved] for row in rows), joints[solved]]
        approaches = np.stack([rows[-1], *rows[-2:0:-1]], axis=1) if len(numbers) else np.zeros((0, N_APPROACH, 7))
        is_short = np.linalg.norm(np.diff(approaches, axis=1), axis=(1, 2)) < _MAX_APPROACH_NORM
        return GoalSet(approaches[is_short], numbers[is_short], np.full(int(is_short.sum()), np.inf))

    def _compute_approach_poses(self, grasps: Array, step: int) -> Array:
        """Return the hand poses (n, 7) in one step of the approaches, from 0 (standoff) to `N_APPROACH` - 1 (grasp)."""
        back = _STANDOFF / N_APPROACH * (N_APPROACH - 1 - step)
        return np.asarray(compose(grasps, np.array([0.0, 0.0, -back, 0.0, 0.0, 0.0, 1.0])))

    def _solve(self, poses: Array, numbers: npt.NDArray[np.int_], starts: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Solve IK for `poses[numbers]` (k, 7) from joints `starts` (k, 7); return joints (k, 7) and success (k,)."""
        rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
        targets = poses[numbers, :3], rotations[numbers]
        return solve_ik(self._arm, *targets, starts, self._limits, _TOLERANCE, _MAX_ITERATIONS)

    def _add_wrist_flips(self, goals: GoalSet) -> GoalSet:
        """Append a copy of each goal with the last joint rotated by pi, unless this exceeds the joint's limits."""
        flipped = goals.approaches.copy()
        # All rows are rotated in the direction of the first one, so that an approach across zero has no jump.
        flipped[..., _LAST_JOINT] -= np.copysign(np.pi, goals.approaches[:, :1, _LAST_JOINT])
        low, high = self._limits[0][_LAST_JOINT], self._limits[1][_LAST_JOINT]
        fits = ((low < flipped[..., _LAST_JOINT]) & (flipped[..., _LAST_JOINT] < high)).all(axis=1)
        copies = replace(goals, approaches=flipped).select(fits)
        return GoalSet(
            np.concatenate([goals.approaches, copies.approaches]),
            np.concatenate([goals.grasps, copies.grasps]),
            np.concatenate([goals.clearances, copies.clearances]),
        )

    def _keeps_orientation(self, goals: Array) -> npt.NDArray[np.bool_]:
        """Return a mask (g,) of the goals (g, 7) on whose straight joint path the hand neither turns far nor tips."""
        shares = np.arange(1, _N_PATH_CHECKS + 1) / (_N_PATH_CHECKS + 1)
        line = self._start + shares[:, None, None] * (goals - self._start)
        rotations = self._arm.compute_chain_frames(line.reshape(-1, 7)).rotations[-1]
        first = self._arm.compute_chain_frames(self._start[None]).rotations[-1][..., 0]
        cosine = (np.einsum("ij,ijn->n", first, rotations) - 1.0) / 2.0
        is_allowed = (cosine >= np.cos(_MAX_ROTATION)) & (rotations[2, 0] >= _MIN_HAND_X_Z)
        return np.asarray(is_allowed.reshape(len(shares), -1).all(axis=0))

    def _is_collision_free(self, standoffs: Array, obstacles: Sequence[Obstacle]) -> npt.NDArray[np.bool_]:
        """Return a mask (g,) of standoffs (g, 7) with at most five colliding arm and hand points; see `_UNCHECKED`."""
        points = transform_body_points(self._arm.compute_link_frames(standoffs), self._body)
        points = points[:, : points.shape[1] - _N_FINGERS * len(self._body[0])]
        hits = np.zeros(len(standoffs), dtype=np.int_)
        for obstacle in obstacles:
            distances = obstacle.compute_distances(points.reshape(3, -1).astype(np.float32))
            hits += (distances.reshape(points.shape[1:]) < COLLISION_DISTANCE).sum(axis=0)
        is_free: npt.NDArray[np.bool_] = hits <= _MAX_COLLISIONS
        if self._unchecked_last:
            is_free[-_UNCHECKED:] = True
        return is_free

    def _remove_similar_goals(self, goals: GoalSet) -> GoalSet:
        """Return at most 100 goals whose standoffs are at least 0.5 rad apart, shuffled with a fixed seed."""
        kept: list[int] = []
        for number, standoff in enumerate(goals.standoffs):
            distances = np.linalg.norm(goals.standoffs[kept] - standoff, axis=1)
            if (distances >= _MIN_GOAL_DISTANCE).all():
                kept.append(number)
        order = np.random.default_rng(0).permutation(len(kept))[:_MAX_GOALS]
        return goals.select(np.array(kept, dtype=np.int_)[order])


class GoalSelector:
    """Online goal selection by mirror descent over experts (Wang et al., 2020, III-C).

    In each round, the cost of the straight joint path from a waypoint of the present trajectory to each goal is
    estimated; later rounds use later waypoints. Each of five experts updates its own weights of all goals by the costs,
    at its own learning rate. The selected goal has the largest mean weight, to which experts with low costs add more.

    Args:
        cost: Obstacle cost of straight paths.
        goals: (g, 7) goal configurations (rad).
        goal_costs: (g,) cost of each goal in addition to the cost of the path to it.
        n_waypoints: Number of waypoints of a trajectory.
        unchecked_last: Whether objects have a cost in all approaches but the last goal's, an error of the authors'
            code; by default, they have none in any approach.
    """

    def __init__(
        self, cost: ObstacleCost, goals: Array, goal_costs: Array, n_waypoints: int, unchecked_last: bool
    ) -> None:
        self._cost, self._goals, self._goal_costs = cost, goals, goal_costs
        self._n_waypoints, self._unchecked_last = n_waypoints, unchecked_last
        count = len(goals)
        self._rates = np.array(_LEARNING_RATES) * np.sqrt(np.log(count + 1) / _N_ROUNDS)
        self._experts = np.full((len(_LEARNING_RATES), count), 1.0 / count)
        self._expert_weights = np.full(len(_LEARNING_RATES), 1.0 / len(_LEARNING_RATES))

    def select_first(self, trajectory: Array) -> int:
        """Return the index of the goal that is cheapest to reach from the first waypoint of a trajectory (w, 7)."""
        return int(np.argmin(self._costs(trajectory, 0)))

    def select_next(self, trajectory: Array, round_number: int) -> int:
        """Update the goals' weights for a trajectory (w, 7) in a round (from 1); return the selected goal's index."""
        costs = self._costs(trajectory, round_number)
        before = self._experts
        self._experts = np.stack(
            [update_weights(expert, rate * costs) for expert, rate in zip(before, self._rates, strict=True)]
        )
        losses = self._experts @ costs + np.abs(self._experts - before).sum(axis=1)
        self._expert_weights = self._expert_weights * np.exp(-losses)
        self._expert_weights /= self._expert_weights.sum()
        return int(np.argmax(self._expert_weights @ self._experts))

    def _costs(self, trajectory: Array, round_number: int) -> Array:
        """Return the costs (g,), scaled to norm 1, of straight paths to the goals from the waypoint of a round."""
        first = min(int(_LOOKAHEAD_RATE * round_number), self._n_waypoints - 1)
        here, count = trajectory[first], self._n_waypoints - first
        is_approach = np.zeros((len(self._goals), count), dtype=bool)
        is_approach[-1 if self._unchecked_last else slice(None), -self._cost.n_approach :] = True
        obstacle_costs = self._cost.evaluate_lines(here, self._goals, count, is_approach)
        smoothness = _SMOOTHNESS_WEIGHT * ((self._goals - here) ** 2).sum(axis=1)
        costs = obstacle_costs + smoothness + self._goal_costs
        return np.asarray(costs / max(float(np.linalg.norm(costs)), np.finfo(np.float64).tiny))


def update_weights(weights: Array, losses: Array) -> Array:
    """Return weights (n,) after a step of mirror descent on the simplex with shifted entropy.

    Each weight w becomes max(0, (w + d) exp(l - loss) - d) with d = 1 / (4 n + 1), and l such that the new weights
    add up to one. The losses (n,) must already be multiplied by the learning rate.
    """
    shift = 1.0 / (4 * len(weights) + 1)
    scaled = (weights + shift) * np.exp(-losses)
    # With the k largest positive, exp(l) is (1 + k d) over their sum, valid while the k-th is positive.
    descending = np.sort(scaled)[::-1]
    levels = (1.0 + shift * np.arange(1, len(weights) + 1)) / np.cumsum(descending)
    n_positive = int(np.flatnonzero(descending * levels > shift)[-1])
    moved = np.maximum(0.0, scaled * levels[n_positive] - shift)
    return np.asarray(moved / moved.sum())
