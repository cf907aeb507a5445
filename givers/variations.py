"""Givers that replay the recording, exactly or with variations that do not depend on the robot."""

import functools
import hashlib
import json
import math
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, bounded, check_order
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, ArrayFactory, to_numpy, widen
from handover_marl.geometry.poses import compute_lengths
from handover_marl.geometry.ycb import CLASS_NAMES
from handover_marl.givers.array_giver import ArrayGiver
from handover_marl.policies.batch import Actions
from handover_marl.policies.policy import PolicyContext

_SPREAD_FILE = files(__package__) / "recording_spread.json"
_ALL_OBJECTS = "all"
# Bounds of the playback rate minus 1.
_MIN_RATE, _MAX_RATE = -0.6, 1.0
_MAX_TIME = 13.0  # s


class ReplayGiver(ArrayGiver):
    """Giver that replays the recording without deviation, as in HandoverSim."""

    name = "replay"

    @property
    def hold_time(self) -> float:
        """Time until the next decision (s): infinite, since the action never changes."""
        return math.inf

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that follow the recordings without deviation."""
        return self.make_actions(rows)


@dataclass(frozen=True)
class HesitantConfig(CheckedConfig):
    """Configuration of `HesitantGiver`.

    Attributes:
        pauses_per_second: Mean number of pauses that start in a second without a pause.
        shortest_pause: Smallest duration of a pause (s).
        longest_pause: Largest duration of a pause (s).
    """

    pauses_per_second: float = bounded(0.6, 0.0, 5.0)
    shortest_pause: float = bounded(0.3, 0.0, _MAX_TIME)
    longest_pause: float = bounded(1.0, 0.0, _MAX_TIME)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "shortest_pause", "longest_pause")


class HesitantGiver(ArrayGiver):
    """Giver that pauses the recorded motion at random times."""

    name = "hesitant"
    default_config = HesitantConfig()
    config: HesitantConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes, on the host like the random numbers."""
        self._until, self._rngs = np.zeros(count), [np.random.default_rng(0)] * count

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without a pause; the seed determines the times of later pauses."""
        self._rngs[row], self._until[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that pause, or replay at the recorded speed."""
        config, numbers = self.config, to_numpy(rows)
        now = to_numpy(observation["time"][:, 0]).astype(np.float64)
        for row, time in zip(numbers.tolist(), now.tolist(), strict=True):
            rng = self._rngs[row]
            if time >= self._until[row] and rng.random() < config.pauses_per_second * self.control_period:
                self._until[row] = time + rng.uniform(config.shortest_pause, config.longest_pause)
        return self.make_pauses(rows, self._arrays.asarray(now < self._until[numbers]))


@dataclass(frozen=True)
class HurriedConfig(CheckedConfig):
    """Configuration of `HurriedGiver`.

    Attributes:
        min_rate: Smallest playback rate minus 1; negative values are slower than recorded.
        max_rate: Largest playback rate minus 1.
    """

    min_rate: float = bounded(0.4, -0.8, 1.0)
    max_rate: float = bounded(1.0, -0.8, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "min_rate", "max_rate")


class HurriedGiver(ArrayGiver):
    """Giver that replays the recorded motion faster, or slower, at a random speed per episode."""

    name = "hurried"
    default_config = HurriedConfig()
    config: HurriedConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._rate = arrays.zeros(count)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with a random playback speed."""
        self._rate[row] = np.random.default_rng(seed).uniform(self.config.min_rate, self.config.max_rate)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that replay at the speeds drawn for these episodes."""
        return self.make_actions(rows, rate=self._rate[rows])


@dataclass(frozen=True)
class DisplacedConfig(CheckedConfig):
    """Configuration of `DisplacedGiver`.

    Attributes:
        distance: Largest distance of the wrist from its recorded position (m).
        angle: Largest rotation of hand and object from their recorded orientation (rad).
    """

    distance: float = bounded(0.15, 0.0, 0.3)
    angle: float = bounded(0.5, 0.0, 1.0)


class DisplacedGiver(ArrayGiver):
    """Giver that displaces and rotates the recorded motion, by a random deviation that is drawn for each episode.

    Displacements are uniformly distributed in a ball, rotations have a random axis and a uniform angle. The hand
    moves to the displaced motion once it has picked up the object.
    """

    name = "displaced"
    default_config = DisplacedConfig()
    config: DisplacedConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._displacement, self._rotation = arrays.zeros((count, 3)), arrays.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with a random deviation."""
        rng = np.random.default_rng(seed)
        radius = self.config.distance * rng.random() ** (1.0 / 3.0)
        self._displacement[row] = self._arrays.asarray(radius * _draw_direction(rng))
        self._rotation[row] = self._arrays.asarray(self.config.angle * rng.random() * _draw_direction(rng))

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the deviations of these episodes."""
        return self.make_actions(rows, displacement=self._displacement[rows], rotation=self._rotation[rows])


def _draw_direction(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return a random unit vector (3,)."""
    return np.asarray(Rotation.random(random_state=rng).as_matrix()[:, 0])


@dataclass(frozen=True)
class NoisyConfig(CheckedConfig):
    """Configuration of `NoisyGiver`.

    Attributes:
        displacement: Standard deviation of each component of the wrist's displacement (m).
        rotation: Standard deviation of each component of the wrist's rotation vector (rad).
        rate: Standard deviation of the playback rate.
        time_constant: Correlation time of the noise (s).
    """

    displacement: float = bounded(0.02, 0.0, 0.1)
    rotation: float = bounded(0.1, 0.0, 0.5)
    rate: float = bounded(0.15, 0.0, 0.5)
    time_constant: float = bounded(0.5, 0.05, 13.0)


class NoisyGiver(ArrayGiver):
    """Giver with Ornstein-Uhlenbeck noise on playback rate, wrist position and wrist rotation.

    The limits of the giver's motion apply, so that fast noise is smoothed.
    """

    name = "noisy"
    default_config = NoisyConfig()
    config: NoisyConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._rngs, self._deviation = [np.random.default_rng(0)] * count, arrays.zeros((count, 7))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation."""
        self._rngs[row], self._deviation[row] = np.random.default_rng(seed), 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the next random deviations from the recordings."""
        config = self.config
        scale = np.array([config.rate, *[config.displacement] * 3, *[config.rotation] * 3])
        decay = float(np.exp(-self.control_period / config.time_constant))
        noise = np.array([self._rngs[row].standard_normal(7) for row in rows.tolist()])
        steps = self._arrays.asarray(np.sqrt(1.0 - decay**2) * scale * noise)
        deviation = self._deviation[rows] = decay * self._deviation[rows] + steps
        return self.make_actions(rows, deviation[:, 0], deviation[:, 1:4], deviation[:, 4:])


@dataclass(frozen=True)
class TiredConfig(CheckedConfig):
    """Configuration of `TiredGiver`.

    Attributes:
        amplitude: Amplitude of the tremor along each axis (m).
        frequency: Frequency of the tremor (Hz).
        sinking: Speed at which the hand sinks (m/s).
        max_sinking: Largest distance by which the hand sinks (m).
    """

    amplitude: float = bounded(0.003, 0.0, 0.02)
    frequency: float = bounded(5.0, 0.5, 8.0)
    sinking: float = bounded(0.02, 0.0, 0.5)
    max_sinking: float = bounded(0.1, 0.0, 0.3)


class TiredGiver(ArrayGiver):
    """Giver that replays the recording with a tremor, and whose hand sinks slowly while it holds the object.

    The tremor is a sine wave along each axis with a random phase. The limits of the giver's motion apply: with the
    default limits, the acceleration of the tremor is at most 5 m/s^2.
    """

    name = "tired"
    # Samples of a period of the fastest tremor: six.
    control_period = 0.02
    default_config = TiredConfig()
    config: TiredConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes."""
        self._phases, self._holding_since = arrays.zeros((count, 3)), arrays.full(count, math.nan)

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with random phases of the tremor."""
        phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
        self._phases[row], self._holding_since[row] = self._arrays.asarray(phases), math.nan

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the present displacements of the hands."""
        xp, config, now = self._arrays.xp, self.config, widen(observation["time"][:, 0])
        since, holds = self._holding_since[rows], observation["holding"][:, 0] != 0.0
        since = self._holding_since[rows] = xp.where(xp.isnan(since) & holds, now, since)
        held = xp.where(xp.isnan(since), 0.0, now - since)
        angles = 2.0 * math.pi * config.frequency * now[:, None] + self._phases[rows]
        displacement = config.amplitude * xp.sin(angles)
        displacement[:, 2] -= (config.sinking * held).clip(max=config.max_sinking)
        return self.make_actions(rows, displacement=displacement)


@dataclass(frozen=True)
class InterruptingConfig(CheckedConfig):
    """Configuration of `InterruptingGiver`.

    Attributes:
        interruptions_per_second: Mean number of interruptions that start in a second without one.
        withdrawal: Distance by which the hand withdraws (m).
        shortest: Smallest duration of an interruption (s).
        longest: Largest duration of an interruption (s).
    """

    interruptions_per_second: float = bounded(0.6, 0.0, 5.0)
    withdrawal: float = bounded(0.15, 0.0, 0.3)
    shortest: float = bounded(0.5, 0.0, _MAX_TIME)
    longest: float = bounded(1.5, 0.0, _MAX_TIME)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order(self, "shortest", "longest")


class InterruptingGiver(ArrayGiver):
    """Giver that withdraws the hand from the gripper at random times, and offers the object again.

    Interruptions start after the object has been picked up and before it is released; their times do not depend
    on the robot. The limits of the giver's motion apply: with the default limits, the hand moves at up to 0.8 m/s
    and 5 m/s^2 relative to the recording, within 0.3 m of it.
    """

    name = "interrupting"
    default_config = InterruptingConfig()
    config: InterruptingConfig

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes; times are on the host like the random numbers."""
        self._until, self._rngs = np.full(count, -1.0), [np.random.default_rng(0)] * count
        self._displacement = arrays.zeros((count, 3))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode without deviation; the seed determines the times of the interruptions."""
        self._rngs[row], self._until[row], self._displacement[row] = np.random.default_rng(seed), -1.0, 0.0

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) that withdraw the hands, or follow the recordings."""
        config, numbers = self.config, to_numpy(rows)
        now, holding, released = (to_numpy(observation[key][:, 0]) for key in ("time", "holding", "released"))
        offsets = widen(observation["object_poses"][:, 0, :3] - observation["gripper_pose"][:, :3])
        away = offsets / compute_lengths(offsets).clip(1e-6)[:, None]
        for place, row in enumerate(numbers.tolist()):
            rng, time = self._rngs[row], float(now[place])
            may_start = time >= self._until[row] and holding[place] and not released[place]
            if may_start and rng.random() < config.interruptions_per_second * self.control_period:
                self._until[row] = time + rng.uniform(config.shortest, config.longest)
                self._displacement[row] = config.withdrawal * away[place]
        is_away = self._arrays.asarray(now < self._until[numbers])[:, None]
        return self.make_actions(rows, displacement=self._arrays.xp.where(is_away, self._displacement[rows], 0.0))


@dataclass(frozen=True)
class RecordingSpreadConfig(CheckedConfig):
    """Configuration of `RecordingSpreadGiver`: factors of the standard deviations between recordings.

    Attributes:
        displacement: Factor of the displacement of the handover pose.
        rotation: Factor of the rotation of the handover pose.
        pace: Factor of the logarithm of the playback speed.
    """

    displacement: float = bounded(1.0, 0.0, 3.0)
    rotation: float = bounded(1.0, 0.0, 3.0)
    pace: float = bounded(1.0, 0.0, 3.0)


class RecordingSpreadGiver(ArrayGiver):
    """Giver that deviates from its recording as other recordings of the same object do.

    In every episode, displacement and rotation of the handover pose and the playback speed are drawn from normal
    distributions. Their standard deviations are those between the recordings of the object in DexYCB's s0 train
    split (`recording_spread.json`; for other objects those over all objects). The limits of the giver's motion apply:
    each component of the displacement is at most 0.3 m, that of the rotation vector at most 1 rad, and the motion is
    at most twice as fast as recorded.
    """

    name = "recording_spread"
    default_config = RecordingSpreadConfig()
    config: RecordingSpreadConfig

    def __init__(self, context: PolicyContext | None = None, **options: float) -> None:
        super().__init__(context, **options)
        self._object_names = CLASS_NAMES if context is None else context.object_names

    @property
    def weights_hash(self) -> str:
        """Hash of the table of standard deviations."""
        return hashlib.sha256(_SPREAD_FILE.read_bytes()).hexdigest()

    def allocate(self, count: int, arrays: ArrayFactory) -> None:
        """Create the arrays of n episodes: random deviations, in standard deviations."""
        self._draws = np.zeros((count, 7))

    def start(self, row: int, seed: int | None) -> None:
        """Start an episode with random deviations."""
        self._draws[row] = np.random.default_rng(seed).standard_normal(7)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) with the deviations of these episodes."""
        config, draws, spread = self.config, self._draws[to_numpy(rows)], _read_spread()
        names = [self._object_names.get(int(number)) for number in to_numpy(observation["object_classes"][:, 0])]
        found = [spread.get(name or _ALL_OBJECTS, spread[_ALL_OBJECTS]) for name in names]
        pace, displacement, rotation = (
            np.array([row[key] for row in found]) for key in ("log_pace", "displacement", "rotation")
        )
        rate = np.clip(np.exp(config.pace * pace * draws[:, 6]) - 1.0, _MIN_RATE, _MAX_RATE)
        shifts = config.displacement * displacement * draws[:, :3]
        turns = config.rotation * rotation * draws[:, 3:6]
        return self.make_actions(rows, *map(self._arrays.asarray, (rate, shifts, turns)))


@functools.cache
def _read_spread() -> dict[str, dict[str, Any]]:
    """Return the standard deviations between recordings by class name of the object."""
    spread: dict[str, dict[str, Any]] = json.loads(_SPREAD_FILE.read_text())["objects"]
    return spread
