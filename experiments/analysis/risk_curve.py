"""Measure success and speed of `reactive` over its option `risk`.

    python experiments/analysis/risk_curve.py --data-dir DIR --out docs/risk.png

The script evaluates `reactive` with several values of `risk` on the validation split and on every tenth scene
of the training split, prints a table with 95 % intervals and plots it. With `--results` an
interrupted run can be continued.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from matplotlib.figure import Figure

from handover_marl import benchmark
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.statistics import compute_mean_interval, compute_wilson_interval
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.learning.training.scene_arguments import EvaluationArgs

FLAGS = (EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the evaluation of `reactive` over its option `risk`.

    Attributes:
        risks: Values of the option `risk`, separated by commas.
        stride: Use every n-th scene of the training split.
        out: Image file of the plot to write.
        results: Folder for results, from which an interrupted run continues; default: none.
    """

    risks: str = "0,0.25,0.5,0.75,1"
    stride: int = 10
    out: str | None = None
    results: str | None = None


def evaluate_risk(risk: float, args: Args) -> list[EpisodeResult]:
    """Evaluate `reactive` with a value of its option `risk`; return the results of all episodes."""
    data = args.open_dataset()
    episodes: list[EpisodeResult] = []
    for split, stride in (("val", 1), ("train", args.stride)):
        report = benchmark(
            split=split,
            receiver=f"reactive:risk={risk}",
            scenes=data.list_scenes(args.setup, split)[::stride],
            out=None if args.results is None else Path(args.results) / f"{risk}-{split}",
            **args.evaluation_options,
        )
        episodes += report.episodes
    return episodes


def compute_rates(episodes: list[EpisodeResult]) -> npt.NDArray[np.float64]:
    """Return success rate and average success (AS) of episodes, with 95 % intervals (%).

    Returns:
        (2, 3) value, lower and upper end of the interval, for success rate and AS.
    """
    scores = [episode.speed_score for episode in episodes]
    n, n_successes = len(episodes), sum(episode.success for episode in episodes)
    success = (n_successes / n, *compute_wilson_interval(n_successes, n))
    return 100 * np.array([success, (sum(scores) / n, *(compute_mean_interval(scores) or (0.0, 0.0)))])


def format_row(risk: float, episodes: list[EpisodeResult]) -> list[str]:
    """Return the cells of the table row for a value of `risk`."""
    success, score = (f"{value:.1f} ({low:.1f} to {high:.1f})" for value, low, high in compute_rates(episodes))
    counts = [sum(bool(episode.status & flag) for episode in episodes) for flag in FLAGS]
    return [f"{risk:g}", success, *(f"{100 * count / len(episodes):.1f}" for count in counts), score]


def plot_rates(episodes_by_risk: dict[float, list[EpisodeResult]], path: Path, heading: str) -> None:
    """Plot success rate and average success (AS) over the option `risk` and write the image.

    Args:
        episodes_by_risk: Results of the episodes by value of `risk`.
        path: Image file to write.
        heading: Title of the plot.
    """
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    measured = np.array([compute_rates(episodes) for episodes in episodes_by_risk.values()])
    for number, label in enumerate(("success", "AS (success and speed in one)")):
        values, low, high = measured[:, number].T
        axes.errorbar(list(episodes_by_risk), values, [values - low, high - values], marker="o", capsize=3, label=label)
    axes.set(xlabel="risk", ylabel="%", title=heading.replace("replay, ", "replay,\n"), ylim=(0, 102))
    axes.title.set_fontsize(9)
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)


def main(args: Args) -> None:
    args = args.resolve_setup()
    episodes_by_risk = {risk: evaluate_risk(risk, args) for risk in map(float, args.risks.split(","))}
    data = args.open_dataset()
    count = len(next(iter(episodes_by_risk.values())))
    heading = (
        f"reactive, wait 0, {args.physics} physics, giver replay, {data.name}, "
        f"{args.setup} val and every {args.stride}th of train, {count} episodes"
    )
    print(f"{heading}; 95 % intervals (Wilson; bootstrap for AS).")
    names = ["risk", "success %", *(f"{flag.label} %" for flag in FLAGS), "AS %"]
    print(format_table(names, [format_row(risk, episodes) for risk, episodes in episodes_by_risk.items()]))
    if args.out is not None:
        plot_rates(episodes_by_risk, Path(args.out), heading)


if __name__ == "__main__":
    main(tyro.cli(Args))
