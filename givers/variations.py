"""Givers that replay the recording, exactly or with variations at times that do not depend on the robot."""

import functools
import hashlib
import json
import math
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import CheckedConfig, bounded
from handover_marl.episode.observations import Observation
from handover_marl.geometry.arrays import AnyIndices, to_float64, to_numpy
from handover_marl.geometry.vectors import compute_lengths
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
        """Return the actions (r, 8) in the episodes `rows`: zeros, which replay the recordings without deviation."""
        return self.make_actions(rows)


@dataclass(frozen=True)
class HesitantConfig(CheckedConfig):
    """Configuration of `HesitantGiver`.

    Attributes:
        pauses_per_second: Mean number of pauses that start per second, not counting time in pauses (1/s).
        shortest_pause: Smallest duration of a pause (s).
        longest_pause: Largest duration of a pause (s).
    """

    ordered_fields: ClassVar = (("shortest_pause", "longest_pause"),)

    pauses_per_second: float = bounded(0.6, 0.0, 5.0)
    shortest_pause: float = bounded(0.3, 0.0, _MAX_TIME)
    longest_pause: float = bounded(1.0, 0.0, _MAX_TIME)


class HesitantGiver(ArrayGiver):
    """Giver that pauses the recorded motion at random times."""

    name = "hesitant"
    config: HesitantConfig = HesitantConfig()
    initial_state: ClassVar = {"until": -1.0}

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: pause at random times, else replay."""
        config, until = self.config, to_numpy(self.state["until"][rows])
        now = to_numpy(observation["time"][:, 0]).astype(np.float64)
        for place, row in enumerate(rows.tolist()):
            rng = self.rngs[row]
            if now[place] >= until[place] and rng.random() < config.pauses_per_second * self.control_period:
                until[place] = now[place] + rng.uniform(config.shortest_pause, config.longest_pause)
        self.state["until"][rows] = self.arrays.asarray(until)
        return self.make_pauses(rows, self.arrays.asarray(now < until))


@dataclass(frozen=True)
class HurriedConfig(CheckedConfig):
    """Configuration of `HurriedGiver`.

    Attributes:
        min_rate: Smallest playback rate minus 1; the rate is the speed relative to the recording.
        max_rate: Largest playback rate minus 1.
    """

    ordered_fields: ClassVar = (("min_rate", "max_rate"),)

    min_rate: float = bounded(0.4, -0.8, 1.0)
    max_rate: float = bounded(1.0, -0.8, 1.0)


class HurriedGiver(ArrayGiver):
    """Giver that replays the recorded motion at another speed, which is drawn for each episode."""

    name = "hurried"
    config: HurriedConfig = HurriedConfig()
    initial_state: ClassVar = {"rate": 0.0}

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row` and draw its playback speed with `seed`."""
        super().start(row, seed)
        self.state["rate"][row] = self.rngs[row].uniform(self.config.min_rate, self.config.max_rate)

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: replay at the speeds drawn for these episodes."""
        return self.make_actions(rows, rate=self.state["rate"][rows])


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
    """Giver that replays the recorded motion with a displacement and a rotation that are drawn for each episode.

    Displacements are uniformly distributed in a ball; rotations have a random axis and a uniform angle. The hand
    moves to the displaced motion once it has picked up the object.
    """

    name = "displaced"
    config: DisplacedConfig = DisplacedConfig()
    initial_state: ClassVar = {"displacement": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0)}

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row` and draw its deviation with `seed`."""
        super().start(row, seed)
        rng = self.rngs[row]
        radius = self.config.distance * rng.random() ** (1.0 / 3.0)
        self.state["displacement"][row] = self.arrays.asarray(radius * _draw_direction(rng))
        self.state["rotation"][row] = self.arrays.asarray(self.config.angle * rng.random() * _draw_direction(rng))

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: displacements and rotations drawn for these episodes."""
        return self.make_actions(rows, **{name: values[rows] for name, values in self.state.items()})


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

    The limits of the giver's motion (`GiverConfig`) apply, so fast noise is smoothed.
    """

    name = "noisy"
    config: NoisyConfig = NoisyConfig()
    initial_state: ClassVar = {"deviation": (0.0,) * 7}

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: the next random deviations from the recordings."""
        config, deviations = self.config, self.state["deviation"]
        scale = np.array([config.rate, *[config.displacement] * 3, *[config.rotation] * 3])
        decay = float(np.exp(-self.control_period / config.time_constant))
        noise = np.array([self.rngs[row].standard_normal(7) for row in rows.tolist()])
        steps = self.arrays.asarray(np.sqrt(1.0 - decay**2) * scale * noise)
        deviation = deviations[rows] = decay * deviations[rows] + steps
        return self.make_actions(rows, rate=deviation[:, 0], displacement=deviation[:, 1:4], rotation=deviation[:, 4:])


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
    """Giver that replays the recording with a tremor and lowers the hand slowly once it holds the object.

    The tremor is a sine wave along each axis with a random phase. The limits of the giver's motion apply: with the
    default limits, the acceleration of the tremor is at most 5 m/s^2.
    """

    name = "tired"
    # The fastest tremor has six samples per period.
    control_period = 0.02
    config: TiredConfig = TiredConfig()
    initial_state: ClassVar = {"phases": (0.0, 0.0, 0.0), "holding_since": math.nan}

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode with index `row` and draw the phases of its tremor with `seed`."""
        super().start(row, seed)
        self.state["phases"][row] = self.arrays.asarray(self.rngs[row].uniform(0.0, 2.0 * np.pi, 3))

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: the present displacements by tremor and sinking."""
        xp, config, now = self.arrays.xp, self.config, to_float64(observation["time"][:, 0])
        since, holds = self.state["holding_since"][rows], observation["holding"][:, 0] != 0.0
        since = self.state["holding_since"][rows] = xp.where(xp.isnan(since) & holds, now, since)
        held = xp.where(xp.isnan(since), 0.0, now - since)
        angles = 2.0 * math.pi * config.frequency * now[:, None] + self.state["phases"][rows]
        displacement = config.amplitude * xp.sin(angles)
        displacement[:, 2] -= (config.sinking * held).clip(max=config.max_sinking)
        return self.make_actions(rows, displacement=displacement)


@dataclass(frozen=True)
class InterruptingConfig(CheckedConfig):
    """Configuration of `InterruptingGiver`.

    Attributes:
        interruptions_per_second: Mean number of interruptions that start per second, not counting time in them (1/s).
        withdrawal: Distance by which the hand withdraws (m).
        shortest: Smallest duration of an interruption (s).
        longest: Largest duration of an interruption (s).
    """

    ordered_fields: ClassVar = (("shortest", "longest"),)

    interruptions_per_second: float = bounded(0.6, 0.0, 5.0)
    withdrawal: float = bounded(0.15, 0.0, 0.3)
    shortest: float = bounded(0.5, 0.0, _MAX_TIME)
    longest: float = bounded(1.5, 0.0, _MAX_TIME)


class InterruptingGiver(ArrayGiver):
    """Giver that withdraws the hand from the gripper at random times, and offers the object again.

    Interruptions start while the person holds the object; until the release, their times do not depend on the
    robot. The limits of the giver's motion apply: with the default limits, the hand moves at up to 0.8 m/s
    and 5 m/s^2 relative to the recording, within 0.3 m of it.
    """

    name = "interrupting"
    config: InterruptingConfig = InterruptingConfig()
    initial_state: ClassVar = {"until": -1.0, "displacement": (0.0, 0.0, 0.0)}

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: withdraw during interruptions, else replay."""
        config, until = self.config, to_numpy(self.state["until"][rows])
        now, holding, released = (to_numpy(observation[key][:, 0]) for key in ("time", "holding", "released"))
        offsets = to_float64(observation["object_poses"][:, 0, :3] - observation["gripper_pose"][:, :3])
        away = offsets / compute_lengths(offsets).clip(1e-6)[:, None]
        for place, row in enumerate(rows.tolist()):
            rng, time = self.rngs[row], float(now[place])
            may_start = time >= until[place] and holding[place] and not released[place]
            if may_start and rng.random() < config.interruptions_per_second * self.control_period:
                until[place] = time + rng.uniform(config.shortest, config.longest)
                self.state["displacement"][row] = config.withdrawal * away[place]
        self.state["until"][rows] = self.arrays.asarray(until)
        is_away = self.arrays.asarray(now < until)[:, None]
        return self.make_actions(
            rows, displacement=self.arrays.xp.where(is_away, self.state["displacement"][rows], 0.0)
        )


@dataclass(frozen=True)
class RecordingSpreadConfig(CheckedConfig):
    """Configuration of `RecordingSpreadGiver`: factors on the standard deviations between recordings.

    Attributes:
        displacement: Factor on the standard deviation of the displacement of the handover pose.
        rotation: Factor on the standard deviation of the rotation of the handover pose.
        pace: Factor on the standard deviation of the logarithm of the playback speed.
    """

    displacement: float = bounded(1.0, 0.0, 3.0)
    rotation: float = bounded(1.0, 0.0, 3.0)
    pace: float = bounded(1.0, 0.0, 3.0)


class RecordingSpreadGiver(ArrayGiver):
    """Giver that deviates from its recording as much as recordings of the same object differ from each other.

    In every episode, displacement and rotation of the handover pose and the logarithm of the playback speed are drawn
    from normal distributions. Their standard deviations (`recording_spread.json`) were computed from the recordings of
    the same object in DexYCB's s0 train split; for objects without recordings there, all recordings were used. The
    playback rate is clipped to 0.4 to 2. The limits of the giver's motion (`GiverConfig`) apply: by default, components
    are at most 0.3 m for the displacement and 1 rad for the rotation vector.
    """

    name = "recording_spread"
    config: RecordingSpreadConfig = RecordingSpreadConfig()
    initial_state: ClassVar = {"draws": (0.0,) * 7}

    def __init__(self, context: PolicyContext | None = None, **options: float) -> None:
        super().__init__(context, **options)
        self._object_names = CLASS_NAMES if context is None else context.object_names

    @property
    def weights_hash(self) -> str:
        """SHA-256 of the file with the standard deviations, which take the place of a network's weights."""
        return hashlib.sha256(_SPREAD_FILE.read_bytes()).hexdigest()

    def start(self, row: int, seed: int | None) -> None:
        """Start the episode `row`; draw 7 standard normal numbers with `seed`: 3 displacement, 3 rotation, 1 pace."""
        super().start(row, seed)
        self.state["draws"][row] = self.arrays.asarray(self.rngs[row].standard_normal(7))

    def decide(self, rows: AnyIndices, observation: Observation) -> Actions:
        """Return the actions (r, 8) in the episodes `rows`: the drawn numbers times the standard deviations."""
        config, draws, spread = self.config, self.state["draws"][rows], _read_spread()
        names = [self._object_names.get(int(number)) for number in to_numpy(observation["object_classes"][:, 0])]
        found = [spread.get(name or _ALL_OBJECTS, spread[_ALL_OBJECTS]) for name in names]
        pace, displacement, rotation = (
            self.arrays.asarray([row[key] for row in found]) for key in ("log_pace", "displacement", "rotation")
        )
        rate = (self.arrays.xp.exp(config.pace * pace * draws[:, 6]) - 1.0).clip(_MIN_RATE, _MAX_RATE)
        shifts = config.displacement * displacement * draws[:, :3]
        turns = config.rotation * rotation * draws[:, 3:6]
        return self.make_actions(rows, rate=rate, displacement=shifts, rotation=turns)


@functools.cache
def _read_spread() -> dict[str, dict[str, Any]]:
    """Return the standard deviations between recordings by the object's class name and the name of the quantity."""
    spread: dict[str, dict[str, Any]] = json.loads(_SPREAD_FILE.read_text())["objects"]
    return spread
