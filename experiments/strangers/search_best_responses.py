"""Search a best response to every giver of a population: settings of the receiver `reactive` for this giver.

    python experiments/strangers/search_best_responses.py --data-dir DIR --out results/best_responses
    python experiments/strangers/search_best_responses.py --data-dir DIR --givers population --out results/population

Every search draws settings at random (random search; Bergstra and Bengio, JMLR 2012) and evaluates them on a few
scenes of the train split. The best of the draws by average success is evaluated on scenes of `--split`. A giver
has several searches, which share no draws. The script prints the best response to every giver, and the result folders
of all searches go to `OUT/best`, from which `handover-marl strangers-references` updates the references. The same
command continues an interrupted search, and with another split evaluates the responses that are known.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

import handover_marl
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.reports.tables import NO_VALUE, format_table
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.pool import map_with_progress
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, load_population

#: Range of each setting, from which a draw takes a number with a uniform distribution of its logarithm.
SEARCH_SPACE = {
    "risk": (0.4, 1.0),
    "approach_standoff": (0.04, 0.12),
    "approach_max_object_speed": (0.1, 0.8),
    "retreat_speed": (0.6, 2.4),
}
_NOT_IN_NAME = re.compile(r"[^\w.-]+")  # characters that folder names do not contain


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the command line.

    Attributes:
        out: Folder of the results.
        population: Name of a shipped population, or path of a file.
        partners: Families of the population: train, test or all.
        givers: Givers with options in place of the population's, such as replay; the giver population is another one in
            each episode. All givers have the same draws.
        searches: Number of searches for each giver.
        draws: Number of settings that a search compares.
        draw_scenes: Number of scenes of the train split on which the draws are compared.
        split: Split of the scenes on which the best draw is evaluated.
        n_scenes: Number of scenes on which the best draw is evaluated.
    """

    out: Path = Path("results/best_responses")
    population: str = DEFAULT_POPULATION
    partners: str = "all"
    givers: tuple[str, ...] = ()
    searches: int = 2
    draws: int = 5
    draw_scenes: int = 4
    split: str = "train"
    n_scenes: int = 36


def draw_policy(rng: np.random.Generator) -> str:
    """Return the receiver `reactive` with random settings as text, their logarithms uniform within `SEARCH_SPACE`."""
    drawn = {key: float(np.exp(rng.uniform(*np.log(limits)))) for key, limits in SEARCH_SPACE.items()}
    return "reactive:" + ",".join(f"{key}={value:.3g}" for key, value in drawn.items())


def search(args: Args, giver: str, folder: Path, seed: tuple[int, ...]) -> handover_marl.Report:
    """Search the best response to a giver, and return its report on the scenes of `Args.split`.

    Args:
        args: Options of the search.
        giver: Giver with its options.
        folder: Folder name of the search below `OUT/draws` and `OUT/best`.
        seed: Seed of the draws.
    """
    rng = np.random.default_rng(seed)
    scenes, few = (
        select_scenes_evenly(args.open_dataset().list_scenes(args.setup, split), n)
        for split, n in ((args.split, args.n_scenes), ("train", args.draw_scenes))
    )
    receivers = [draw_policy(rng) for _ in range(args.draws)]
    scores = [
        evaluate_draw(args, giver, receiver, "train", few, args.out / "draws" / folder / str(number)).average_success
        for number, receiver in enumerate(receivers)
    ]
    best = receivers[int(np.argmax(scores))]
    return evaluate_draw(args, giver, best, args.split, scenes, args.out / "best" / args.split / folder)


def evaluate_draw(
    args: EvaluationArgs, giver: str, receiver: str, split: str, scenes: tuple[int, ...], folder: Path
) -> handover_marl.Report:
    """Evaluate a giver with a receiver in scenes of a split in this process, and write the result folder."""
    options = args.evaluation_options | {"workers": 1, "progress": False, "out": str(folder)}
    return handover_marl.evaluate_pair(giver, receiver, split=split, scenes=scenes, **options)


def format_results(partners: tuple[Partner, ...], found: dict[tuple[int, int], handover_marl.Report]) -> str:
    """Return the table of the best responses, one row for each partner, from reports by partner's index and search."""
    rows = []
    for number, partner in enumerate(partners):
        responses = [found[key] for key in sorted(found) if key[0] == number]
        best = max(responses, key=lambda response: response.average_success)
        scores = ", ".join(f"{100 * response.average_success:.1f}" for response in responses)
        cells = [f"{100 * best.success_rate:.1f}", len(best.episodes), best.metadata.receiver]
        rows.append([partner.name, partner.family, scores, *cells])
    return format_table(["giver", "family", "AS % of searches", "success % of the best", "n", "best response"], rows)


def list_partners(args: Args) -> tuple[Partner, ...]:
    """Return the givers of the search as partners; givers outside of the population have no family."""
    if not args.givers:
        population = load_population(args.population)
        chosen = population.select("giver", args.partners)
        return tuple(replace(partner, policy=population.get_policy(partner)) for partner in chosen)
    return tuple(Partner(_NOT_IN_NAME.sub("_", giver), NO_VALUE, "", giver, "") for giver in args.givers)


def main(args: Args) -> None:
    """Search in worker processes, one giver and search at a time each, and print the best responses."""
    args = args.resolve_setup()
    partners = list_partners(args)
    tasks = [(number, repeat) for number in range(len(partners)) for repeat in range(args.searches)]

    def make_search() -> Callable[[tuple[int, int]], handover_marl.Report]:
        def run(task: tuple[int, int]) -> handover_marl.Report:
            number, repeat = task
            partner, seed = partners[number], (0 if args.givers else number, repeat)
            return search(args, partner.policy, Path(f"{partner.name}-{repeat}"), seed)

        return run

    found = dict(map_with_progress(make_search, tasks, "best responses", PoolConfig(args.workers), progress=True))
    print(format_results(partners, found))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
