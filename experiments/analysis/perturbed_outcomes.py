"""Measure the sensitivity of outcomes: the same episodes with perturbed joint targets.

    python experiments/analysis/perturbed_outcomes.py --data-dir DIR --split train --stride 5

Every scene is simulated without a perturbation and once for each size of perturbation, which is
added to all joint targets with signs drawn for the scene. The share of episodes with the same
outcome is an upper bound for the agreement of another physics engine whose joints deviate by that
much.
"""

from collections import Counter
from dataclasses import dataclass

import tyro

from handover_marl import __version__, receivers
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.tables import format_percent_rate, format_table
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import map_with_progress
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.policies.perturbed import PerturbedReceiver


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the measurement of outcomes under perturbed joint targets.

    Attributes:
        receiver: Name of the receiver whose joint targets are perturbed.
        offsets: Sizes of the perturbations (rad).
        split: Split of the setup: train or val; the test split is for final results.
        stride: Use every n-th scene of the split.
    """

    receiver: str = "yang2021"
    offsets: tuple[float, ...] = (1e-4, 1e-3)
    split: str = "train"
    stride: int = 1


class PerturbedSimulator:
    """Simulator of episodes with perturbed joint targets, in one process.

    Args:
        args: Options of the script.
    """

    def __init__(self, args: Args) -> None:
        self._data = args.open_dataset()
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._episode = Episode(args.physics)
        self._offsets = args.offsets

    def simulate(self, number: int) -> list[EpisodeStatus]:
        """Simulate a scene without perturbation and with each size; return the outcomes in order.

        Args:
            number: Scene number, which also seeds the signs of the perturbations.
        """
        scene, statuses = self._data.load_scene(number), []
        for offset in (0.0, *self._offsets):
            self._episode.reset(scene)
            run_episode(self._episode, PerturbedReceiver(self._receiver, offset, number), seed=0)
            statuses.append(self._episode.status)
        return statuses


def main(args: Args) -> None:
    args = args.resolve_setup()
    data = args.open_dataset()
    numbers = data.list_scenes(args.setup, args.split)[:: args.stride]
    pool = PoolConfig(args.workers)
    outcomes = [
        statuses
        for _, statuses in map_with_progress(lambda: PerturbedSimulator(args).simulate, numbers, "playing", pool, True)
    ]
    rows = []
    for place, offset in enumerate((0.0, *args.offsets)):
        alike = sum(statuses[place] == statuses[0] for statuses in outcomes)
        counts = Counter(statuses[place].label for statuses in outcomes)
        rates = ", ".join(f"{name} {100 * count / len(outcomes):.1f}" for name, count in sorted(counts.items()))
        rows.append([f"{offset:g}", format_percent_rate(alike, len(outcomes)), rates])
    print(
        f"{args.setup} {args.split}, {len(outcomes)} episodes each, receiver {args.receiver}, giver replay, "
        f"{data.name}, {args.physics} physics, version {__version__}; Wilson's 95 % intervals.\n"
    )
    print(format_table(["perturbation (rad)", "ends as without, %", "ends, %"], rows))


if __name__ == "__main__":
    main(tyro.cli(Args))
