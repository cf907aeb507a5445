"""Measure the sensitivity of outcomes: the same episodes with perturbed joint targets.

    python experiments/analysis/perturbed_outcomes.py --data-dir DIR --split train --stride 5

Every scene is simulated without a perturbation and once for each size of perturbation, which is
added to all joint targets with signs drawn for the scene. The share of episodes with the same
outcome is an upper bound for the agreement of another physics engine whose joints deviate by that
much.
"""

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from unittest import mock

import numpy as np
import tyro

from handover_marl import __version__, receivers
from handover_marl.config import ARM_DOF
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import play
from handover_marl.episode.observations import Observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.tables import format_percent_rate, format_table
from handover_marl.execution.pool import PoolConfig
from handover_marl.execution.tasks import map_with_progress
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.policies.policy import Action


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the measurement of outcomes under perturbed joint targets.

    Attributes:
        receiver: Name of the receiver whose joint targets are perturbed.
        nudges: Sizes of the perturbations (rad).
        split: Split of the setup: train or val; the test split is for final results.
        stride: Use every n-th scene of the split.
    """

    receiver: str = "yang2021"
    nudges: tuple[float, ...] = (1e-4, 1e-3)
    split: str = "train"
    stride: int = 1


class Scenes:
    """Simulator of scenes with perturbed joint targets, in one process."""

    def __init__(self, args: Args) -> None:
        self._data = args.open_dataset()
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._episode = Episode(args.physics)
        self._nudges = args.nudges

    def play(self, number: int) -> list[EpisodeStatus]:
        """Return the outcomes of a scene without and with each perturbation."""
        scene, found = self._data.load_scene(number), []
        ways = np.random.default_rng(number).choice([-1.0, 1.0], ARM_DOF)
        for nudge in (0.0, *self._nudges):
            self._episode.reset(scene)
            with mock.patch.object(
                self._receiver, "act", functools.partial(act_nudged, self._receiver.act, nudge * ways)
            ):
                play(self._episode, self._receiver, seed=0)
            found.append(self._episode.status)
        return found


def act_nudged(act: Callable[[Observation], Action], shifts: np.ndarray, observation: Observation) -> Action:
    """Return a receiver's action with the offsets (7,) (rad) added to the arm's joint targets."""
    action = np.array(act(observation), dtype=np.float32)
    action[:ARM_DOF] += shifts.astype(np.float32)
    return action


def main(args: Args) -> None:
    data = args.open_dataset()
    numbers = data.list_scenes(args.setup, args.split)[:: args.stride]
    pool = PoolConfig(args.workers)
    ends = [found for _, found in map_with_progress(lambda: Scenes(args).play, numbers, "playing", pool, True)]
    rows = []
    for place, nudge in enumerate((0.0, *args.nudges)):
        alike = sum(found[place] == found[0] for found in ends)
        counts = Counter(found[place].label for found in ends)
        rates = ", ".join(f"{name} {100 * count / len(ends):.1f}" for name, count in sorted(counts.items()))
        rows.append([f"{nudge:g}", format_percent_rate(alike, len(ends)), rates])
    print(
        f"{args.setup} {args.split}, {len(ends)} episodes each, receiver {args.receiver}, giver replay, {data.name}, "
        f"{args.physics} physics, version {__version__}; Wilson's 95 % intervals.\n"
    )
    print(format_table(["nudge (rad)", "ends as without, %", "ends, %"], rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
