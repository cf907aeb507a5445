"""Givers that react to the robot: they help it, wait for it, withdraw from it or release the object early."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from handover_marl.config import TIME_STEP, CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import NUMPY_ARRAYS, AnyArray, AnyIndices, ArrayFactory, to_float64
from handover_marl.geometry.panda import FINGERTIPS
from handover_marl.geometry.poses import transform_points
from handover_marl.geometry.rotations import quaternions_from_rotation_vectors, rotate_points
from handover_marl.geometry.vectors import compute_dot_products, compute_lengths
from handover_marl.givers.array_giver import (
    ArrayGiver,
    compute_gripper_object_distances,
    compute_withdrawals,
    is_hand_previewed,
)
from handover_marl.policies.batch import Actions

# Observed times are float32 and may be rounded down: durations count as over half a physics step earlier.
_TIME_TOLERANCE = 0.5 * TIME_STEP


class HandoverPoseVariation:
    """Factor on the deviation from the recorded handover pose, which changes while the robot does not approach.

    A giver multiplies its displacement and rotation by `scale`, one number for each of `count` episodes. The factor
    becomes the next of `scales` each time that the gripper has not come nearer to the object by `min_approach` for the
    time `timeout`.

    Attributes:
        scale: (count,) present factor of each episode; 0 gives the recorded pose.
        timeout: Time without an approach after which the factor changes (s).
        min_approach: Smallest decrease of the distance to the object that counts as an approach (m).
        scales: Factors in order; the first follows the last.
    """

    timeout = 2.0
    min_approach = 0.02
    scales = (1.0, 0.0, 0.5, -0.5)

    def __init__(self, count: int, arrays: ArrayFactory = NUMPY_ARRAYS) -> None:
        self._xp, self._scales = arrays.xp, arrays.asarray(self.scales)
        self.scale = arrays.full(count, self.scales[0])
        self._timeouts, self._min_distance = arrays.zeros(count, "int64"), arrays.full(count, math.inf)
        self._since = arrays.full(count, math.nan)

    def reset(self, row: int) -> None:
        """Start the episode with index `row`, with the first of `scales`."""
        self.scale[row], self._timeouts[row] = self.scales[0], 0
        self._min_distance[row], self._since[row] = math.inf, math.nan

    def update(self, rows: AnyIndices, observation: Observation) -> None:
        """Change `scale` in the episodes among `rows` (r,) in which the gripper has not approached for `timeout`."""
        xp, now = self._xp, to_float64(observation["time"][:, 0])
        distance = compute_gripper_object_distances(observation)
        since, closest = self._since[rows], self._min_distance[rows]
        nearer = xp.isnan(since) | (distance < closest - self.min_approach)
        late = ~nearer & (now - since >= self.timeout - _TIME_TOLERANCE)
        self._timeouts[rows] += late
        number = self._timeouts[rows] % len(self.scales)
        self.scale[rows] = xp.where(late, self._scales[number], self.scale[rows])
        self._since[rows] = xp.where(nearer | late, now, since)
        self._min_distance[rows] = xp.where(nearer, distance, xp.where(late, math.inf, closest))


@dataclass(frozen=True)
class CooperativeConfig(CheckedConfig):
    """Configuration of `CooperativeGiver`.

    Attributes:
        approach_share: Share of the distance to the gripper by which the object is moved towards the gripper.
        min_distance: Distance from gripper to object (m); the object is not moved closer to the gripper than this.
        max_displacement: Largest displacement of the object from its recorded position (m).
        max_rotation: Largest rotation of hand and object from their recorded orientation (rad).
        rate: Playback rate minus 1 until the release; positive values are faster than recorded.
        withdrawal: Distance by which the hand withdraws after the release (m).
    """

    approach_share: float = bounded(0.3, 0.0, 1.0)
    min_distance: float = bounded(0.45, 0.0, 2.0)
    max_displacement: float = bounded(0.25, 0.0, 0.3)
    max_rotation: float = bounded(0.8, 0.0, 1.0)
    rate: float = bounded(0.0, -0.8, 1.0)
    withdrawal: float = bounded(0.15, 0.0, 0.3)


class CooperativeGiver(ArrayGiver):
    """Giver that holds out the object towards the gripper, waits for a grasp, releases the object and withdraws.

    While the recorded hand moves to its handover pose, the giver turns the hand so that the object is between hand and
    gripper, and moves the object towards the gripper. The pose is fixed once the recorded hand has stopped or the
    gripper is near, because robots take resting objects best. `HandoverPoseVariation` varies the pose if the gripper
    does not approach. The hand releases the object when the robot's fingers seem to hold it (they rest, partly closed,
    near the object), and withdraws after any release.

    Args:
        context: Robot and task, which this giver does not use.
        options: Numbers in `CooperativeConfig`.

    Attributes:
        near_distance: Distance from gripper to object below which the gripper counts as near (m).
        arrival_tolerance: Motion of the recorded wrist in the next 0.5 s below which the hand counts as stopped (m).
        grasp_time: Time for which the robot's fingers must seem to hold the object before the release (s).
    """

    name = "cooperative"
    near_distance = 0.25
    arrival_tolerance = 0.01
    grasp_time = 0.2
    config: CooperativeConfig = CooperativeConfig()
    initial_state: ClassVar = {
        "displacement": (0.0, 0.0, 0.0),
        "rotation": (0.0, 0.0, 0.0),
        "withdrawal": (0.0, 0.0, 0.0),
        "is_fixed": False,
        "is_withdrawn": False,
        "grasped_since": math.nan,
    }

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the state of `count` episodes, in arrays that `arrays` creates."""
        super().allocate(count, arrays)
        self._pose_variation = HandoverPoseVariation(count, arrays)

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row` without deviation from the recording; the giver is not random."""
        super().start(row, seed)
        self._pose_variation.reset(row)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return actions (r, 8): hold out the object, release it when the fingers seem to hold it, then withdraw."""
        xp, state = self.arrays.xp, self.state
        released = observation["released"][:, 0] != 0.0
        present = is_hand_previewed(observation)
        near = compute_gripper_object_distances(observation) < self.near_distance
        chooses = xp.nonzero(~released & present & ~state["is_fixed"][rows])[0]
        if len(chooses):
            self._choose_poses(rows[chooses], {key: value[chooses] for key, value in observation.items()})
        state["is_fixed"][rows] |= ~released & (near | self._has_arrived(observation))
        waiting = xp.nonzero(~released & state["is_fixed"][rows])[0]
        if len(waiting):
            self._pose_variation.update(rows[waiting], {key: value[waiting] for key, value in observation.items()})
        scale = self._pose_variation.scale[rows, None]
        displacement = scale * state["displacement"][rows]
        self._withdraw(rows, released & ~state["is_withdrawn"][rows], displacement, observation)
        return self.make_actions(
            rows,
            rate=xp.where(released, 0.0, self.config.rate),
            displacement=xp.where(released[:, None], state["withdrawal"][rows], displacement),
            rotation=scale * state["rotation"][rows],
            release=~released & self._are_grasped(rows, ~released, near, observation),
        )

    def _has_arrived(self, observation: Observation) -> AnyArray:
        """Return a mask (r,): whether the hand holds the object, and the recorded wrist hardly moves for 0.5 s."""
        xp, wrist = self.arrays.xp, observation["replay_wrist_poses"][..., :3]
        moves = to_float64(xp.max(xp.abs(wrist - wrist[:, :1]), axis=(1, 2)))
        return (observation["holding"][:, 0] != 0.0) & (moves < self.arrival_tolerance)

    def _choose_poses(self, rows: AnyIndices, observation: Observation) -> None:
        """Store displacements and rotations that bring the object, as recorded 0.5 s ahead, closer to the gripper."""
        xp, config = self.arrays.xp, self.config
        gripper = to_float64(observation["gripper_pose"][:, :3])
        wrist = to_float64(observation["replay_wrist_poses"][:, -1, :3])
        item = to_float64(observation["replay_object_poses"][:, -1, :3])
        direction = gripper - item
        rotation = self._rotate_towards(item - wrist, direction)
        distance = compute_lengths(direction)
        wanted = xp.minimum(config.approach_share * distance, distance - config.min_distance)
        length = wanted.clip(0.0, config.max_displacement)
        target = item + direction / distance.clip(1e-6)[:, None] * length[:, None]
        # The rotation moves the object about the wrist; the displacement compensates for it.
        moved = rotate_points(quaternions_from_rotation_vectors(rotation), item - wrist)
        self.state["displacement"][rows], self.state["rotation"][rows] = target - moved - wrist, rotation

    def _rotate_towards(self, arms: AnyArray, directions: AnyArray) -> AnyArray:
        """Return rotation vectors (r, 3) that turn vectors `arms` (r, 3) to `directions`, by at most `max_rotation`."""
        xp = self.arrays.xp
        axes = xp.linalg.cross(arms, directions)
        size = compute_lengths(axes)
        angle = xp.atan2(size, compute_dot_products(arms, directions)).clip(max=self.config.max_rotation)
        is_turned = size >= 1e-9
        return xp.where(is_turned[:, None], axes / xp.where(is_turned, size, 1.0)[:, None] * angle[:, None], 0.0)

    def _are_grasped(self, rows: AnyIndices, held: AnyArray, near: AnyArray, observation: Observation) -> AnyArray:
        """Return a mask (r,): whether the robot's fingers have seemed to hold the object for `grasp_time`.

        They seem to hold it while they are at rest, neither open nor closed, and near the object (mask `near`, (r,)).
        Only time before the release counts (mask `held`, (r,)).
        """
        xp, now = self.arrays.xp, to_float64(observation["time"][:, 0])
        fingers, speeds = (to_float64(observation[f"robot_joint_{key}"][:, 7:]) for key in ("position", "velocity"))
        resting = xp.all((xp.abs(speeds) < 2e-3) & (fingers > 1e-3) & (fingers < 0.0385), axis=1) & near
        since = self.state["grasped_since"][rows]
        since = xp.where(held, xp.where(resting, xp.where(xp.isnan(since), now, since), math.nan), since)
        self.state["grasped_since"][rows] = since
        return resting & (now - since >= self.grasp_time - _TIME_TOLERANCE)

    def _withdraw(self, rows: AnyIndices, begins: AnyArray, shift: AnyArray, observation: Observation) -> None:
        """Store the displacements to which hands withdraw, in the episodes where the mask `begins` (r,) is True.

        They are the set points `shift` (r, 3) until now (m), plus `config.withdrawal` away from the gripper.
        """
        withdrawal = shift + compute_withdrawals(observation, self.config.withdrawal)
        withdrawn = self.state["withdrawal"]
        withdrawn[rows] = self.arrays.xp.where(begins[:, None], withdrawal, withdrawn[rows])
        self.state["is_withdrawn"][rows] |= begins


@dataclass(frozen=True)
class StopWhenNearConfig(CheckedConfig):
    """Configuration of `StopWhenNearGiver`.

    Attributes:
        distance: Distance from the Panda's hand link to the object's origin below which the recording pauses (m).
    """

    distance: float = bounded(0.35, 0.0, 1.5)


class StopWhenNearGiver(ArrayGiver):
    """Giver that pauses the recording while the gripper is near the object.

    A similar giver is in GenH2R (Wang et al., CVPR 2024).
    """

    name = "stop_when_near"
    config: StopWhenNearConfig = StopWhenNearConfig()

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: pause while the gripper is near the object, else replay."""
        return self.make_pauses(rows, compute_gripper_object_distances(observation) < self.config.distance)


@dataclass(frozen=True)
class WithdrawingConfig(CheckedConfig):
    """Configuration of `WithdrawingGiver`.

    Attributes:
        max_speed: Speed at which gripper and wrist approach each other above which the hand withdraws (m/s).
        max_distance: Distance from gripper to wrist beyond which the hand does not withdraw (m).
        withdrawal: Distance by which the hand withdraws (m).
        return_after: Time from the last fast approach to the return of the hand (s).
    """

    max_speed: float = bounded(0.25, 0.0, 2.0)
    max_distance: float = bounded(0.45, 0.0, 1.5)
    withdrawal: float = bounded(0.15, 0.0, 0.3)
    return_after: float = bounded(0.8, 0.0, 13.0)


class WithdrawingGiver(ArrayGiver):
    """Giver that withdraws the hand when the gripper approaches fast, and returns later; meant as a stress test."""

    name = "withdrawing"
    config: WithdrawingConfig = WithdrawingConfig()
    initial_state: ClassVar = {"last_distance": math.nan, "until": -1.0, "displacement": (0.0, 0.0, 0.0)}

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: withdraw for a time after a fast approach, else replay."""
        xp, config, state, now = self.arrays.xp, self.config, self.state, to_float64(observation["time"][:, 0])
        away = observation["hand_keypoints"][:, 0] - observation["gripper_pose"][:, :3]
        distance = to_float64(compute_lengths(away))
        speed = (state["last_distance"][rows] - distance) / self.control_period
        # Before the second decision with a hand, the speed is nan, which is not above the limit.
        is_present = observation["hand_present"][:, 0] != 0.0
        state["last_distance"][rows] = xp.where(is_present, distance, math.nan)
        withdraws = is_present & (distance < config.max_distance) & (speed > config.max_speed)
        until = xp.where(withdraws, now + config.return_after - _TIME_TOLERANCE, state["until"][rows])
        withdrawal = compute_withdrawals(observation, config.withdrawal)
        displacement = xp.where(withdraws[:, None], withdrawal, state["displacement"][rows])
        state["until"][rows], state["displacement"][rows] = until, displacement
        return self.make_actions(rows, displacement=xp.where((now < until)[:, None], displacement, 0.0))


@dataclass(frozen=True)
class EarlyReleaseConfig(CheckedConfig):
    """Configuration of `EarlyReleaseGiver`.

    Attributes:
        distance: Distance from the point between the robot's fingertips to the object's origin below which the gripper
            counts as near (m).
        max_delay: Largest delay of the release after the gripper is first near (s); each episode draws a delay.
    """

    distance: float = bounded(0.1, 0.0, 0.5)
    max_delay: float = bounded(0.5, 0.0, 13.0)


class EarlyReleaseGiver(ArrayGiver):
    """Giver that replays the recording and releases the object soon after the gripper has come near.

    The release does not depend on a grasp, so the robot must close its fingers in time. By the rules of the task,
    a firm grasp before this time leads to a release, too.
    """

    name = "early_release"
    control_period = 0.02
    config: EarlyReleaseConfig = EarlyReleaseConfig()
    initial_state: ClassVar = {"delay": 0.0, "near_since": math.nan}

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row` and draw its delay with `seed`."""
        super().start(row, seed)
        self.state["delay"][row] = self.config.max_delay * self.rngs[row].random()

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: replay, and release the object after the delay."""
        xp, now = self.arrays.xp, to_float64(observation["time"][:, 0])
        fingertips = transform_points(observation["gripper_pose"], np.array(FINGERTIPS))
        distance = compute_lengths(fingertips - observation["object_poses"][:, 0, :3])
        is_near = (distance < self.config.distance) & (observation["holding"][:, 0] != 0.0)
        since = self.state["near_since"][rows]
        since = self.state["near_since"][rows] = xp.where(xp.isnan(since) & is_near, now, since)
        return self.make_actions(rows, release=now - since >= self.state["delay"][rows])
