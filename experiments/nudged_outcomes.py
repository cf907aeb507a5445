"""How much of an outcome hangs on next to nothing: the same episodes with the arm's targets a little beside.

    python experiments/nudged_outcomes.py --data-dir DIR --split train --stride 5

Every scene is played as it is, and once for each nudge, with each joint's targets shifted by so much, up or down as
drawn for the scene. How often episodes still end alike says how well any other physics could agree at all whose arm
is that much elsewhere.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import tyro

from handover_marl import receivers
from handover_marl._version import __version__
from handover_marl.benchmarking.tables import percent_rate, table
from handover_marl.config import ARM_JOINTS, PANDA_DOF
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import Observation
from handover_marl.episode.play import play
from handover_marl.policies.policy import Action
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.receivers import Receiver


@dataclass(frozen=True)
class Args:
    """What to play.

    Attributes:
        receiver: Whose targets are nudged.
        nudges: By how much (rad).
        setup: Official setup, s0 to s3.
        split: train or val; choose nothing on test.
        stride: Take every n-th scene.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: exact, fast or mujoco.
        workers: Processes; default: one a core.
    """

    receiver: str = "yang2021"
    nudges: tuple[float, ...] = (1e-4, 1e-3)
    setup: str = "s0"
    split: str = "train"
    stride: int = 1
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    workers: int | None = None


class Nudged:
    """Another receiver whose arm's targets are a little beside.

    Args:
        receiver: The other one.
        shifts: (7,) how far (rad).
    """

    def __init__(self, receiver: Receiver, shifts: np.ndarray) -> None:
        self._receiver = receiver
        self._shifts = np.zeros(PANDA_DOF, dtype=np.float32)
        self._shifts[:ARM_JOINTS] = shifts
        self.name = f"nudged {receiver.name}"
        self.sight, self.observes = receiver.sight, receiver.observes

    def prepare(self, object_names: Sequence[str]) -> None:
        self._receiver.prepare(object_names)

    def reset(self, seed: int | None = None) -> None:
        self._receiver.reset(seed)

    def act(self, observation: Observation) -> Action:
        return np.asarray(self._receiver.act(observation) + self._shifts, dtype=np.float32)

    @property
    def hold_time(self) -> float:
        return self._receiver.hold_time


class Scenes:
    """Plays scenes in one process."""

    def __init__(self, args: Args) -> None:
        self._data = open_dataset(args.dataset, args.data_dir)
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._episode = Episode(args.physics)
        self._nudges = args.nudges

    def play(self, number: int) -> list[EpisodeStatus]:
        """How one scene ends as it is, and with each nudge."""
        scene, found = self._data.scene(number), []
        ways = np.random.default_rng(number).choice([-1.0, 1.0], ARM_JOINTS)
        for nudge in (0.0, *self._nudges):
            self._episode.reset(scene)
            play(self._episode, Nudged(self._receiver, nudge * ways), seed=0)
            found.append(self._episode.status)
        return found


def main(args: Args) -> None:
    data = open_dataset(args.dataset, args.data_dir)
    numbers = data.split(args.setup, args.split)[:: args.stride]
    pool = PoolConfig(args.workers)
    ends = [found for _, found in worked_on(lambda: Scenes(args).play, numbers, "playing", pool, True)]
    rows = []
    for place, nudge in enumerate((0.0, *args.nudges)):
        alike = sum(found[place] == found[0] for found in ends)
        counts = Counter(found[place].label for found in ends)
        rates = ", ".join(f"{name} {100 * count / len(ends):.1f}" for name, count in sorted(counts.items()))
        rows.append([f"{nudge:g}", percent_rate(alike, len(ends)), rates])
    print(
        f"{args.setup} {args.split}, {len(ends)} episodes each, receiver {args.receiver}, giver replay, {data.name}, "
        f"{args.physics} physics, version {__version__}; Wilson's 95 % intervals.\n"
    )
    print(table(["nudge (rad)", "ends as without, %", "ends, %"], rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
