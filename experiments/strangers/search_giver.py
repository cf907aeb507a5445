"""Search settings of the giver `cooperative` that help the receivers of a population.

    python experiments/strangers/search_giver.py --data-dir DIR --out results/giver

Every search draws settings at random (random search; Bergstra and Bengio, JMLR 2012) and evaluates them with every
receiver of the train families in a few scenes of the train split. The result of a search is the draw with the largest
mean score over receivers and scenes: success rate, or average success (AS). Searches share no draws. The same command
continues an interrupted search.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from search_best_responses import draw_policy, evaluate_draw

from handover_marl import __version__
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import map_with_progress
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.policies.populations import DEFAULT_POPULATION, TRAIN, load_population

#: Range of each setting, from which a draw takes a number with a uniform distribution.
SEARCH_SPACE = {
    "approach_share": (0.0, 0.6),
    "min_distance": (0.3, 0.6),
    "max_displacement": (0.0, 0.25),
    "max_rotation": (0.0, 0.8),
    "rate": (-0.2, 1.0),
    "withdrawal": (0.0, 0.3),
}
_REPLAY = "replay"


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the command line.

    Attributes:
        out: Folder of the results.
        population: Name of a shipped population, or path of a file.
        score: Score that is compared: AS or success.
        searches: Number of searches.
        draws: Number of settings that a search compares.
        n_scenes: Number of scenes of the train split for each receiver.
    """

    out: Path = Path("results/giver")
    population: str = DEFAULT_POPULATION
    score: Literal["AS", "success"] = "AS"
    searches: int = 3
    draws: int = 10
    n_scenes: int = 6


def list_givers(args: Args) -> list[tuple[str, ...]]:
    """Return the givers that each search compares."""
    return [
        tuple(
            draw_policy("cooperative", SEARCH_SPACE, np.random.default_rng((seed, number)), logarithmic=False)
            for number in range(args.draws)
        )
        for seed in range(args.searches)
    ]


def format_results(searches: list[tuple[str, ...]], scores: dict[str, list[float]], label: str) -> str:
    """Return the table of the best giver of every search.

    Args:
        searches: Givers that each search compared.
        scores: Score (0..1) with every receiver, by giver; `replay` among them.
        label: Name of the score.
    """
    rows = [_format_row("-", _REPLAY, scores)]
    for number, givers in enumerate(searches):
        rows.append(_format_row(str(number), max(givers, key=lambda giver: np.mean(scores[giver])), scores))
    return format_table(["search", "giver", f"{label} %", "minus replay"], rows, max_width=1000)


def _format_row(number: str, giver: str, scores: dict[str, list[float]]) -> list[str]:
    own, usual = (100.0 * np.mean(scores[name]) for name in (giver, _REPLAY))
    return [number, giver, f"{own:.1f}", f"{own - usual:+.1f}"]


def main(args: Args) -> None:
    """Evaluate all draws in worker processes, and print the best giver of every search."""
    args = args.resolve_setup()
    population = load_population(args.population)
    receivers = [population.get_policy(partner) for partner in population.select("receiver", TRAIN)]
    data = args.open_dataset()
    scenes = select_scenes_evenly(data.list_scenes(args.setup, "train"), args.n_scenes)
    searches = list_givers(args)
    givers = [_REPLAY, *(giver for draws in searches for giver in draws)]
    tasks = [(giver, receiver) for giver in givers for receiver in receivers]

    def make_evaluation() -> Callable[[tuple[str, str]], float]:
        def run(task: tuple[str, str]) -> float:
            folder = args.out / f"{givers.index(task[0])}-{receivers.index(task[1])}"
            report = evaluate_draw(args, *task, "train", scenes, folder)
            return report.success_rate if args.score == "success" else report.average_success

        return run

    found = dict(map_with_progress(make_evaluation, tasks, "givers", PoolConfig(args.workers), progress=True))
    scores = {giver: [found[giver, receiver] for receiver in receivers] for giver in givers}
    print(format_results(searches, scores, args.score))
    print(
        f"\n{data.name}, {args.setup} train, {len(scenes)} scenes, {len(receivers)} receivers, {args.physics} physics, "
        f"version {__version__}. The scenes have chosen the givers, so that their scores are optimistic."
    )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
