"""Measure success and speed of `reactive` over its option `risk`.

    python experiments/analysis/risk_curve.py --data-dir DIR --out docs/risk.png

Evaluates `reactive` with several values of `risk` on the validation split and on every tenth scene
of the training split, prints a table with 95 % intervals and plots it. With `--results` an
interrupted run can be continued.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.figure import Figure

from handover_marl import benchmark
from handover_marl.datasets import open_dataset
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.statistics import compute_mean_interval, compute_wilson_interval
from handover_marl.evaluation.reports.tables import format_percent_rate, format_table
from handover_marl.evaluation.results.episode_result import EpisodeResult

FLAGS = (EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)


@dataclass(frozen=True)
class Args:
    """Options of the evaluation of `reactive` over its option `risk`.

    Attributes:
        risks: Values of the option `risk`, separated by commas.
        setup: Official setup, s0 to s3.
        stride: Use every n-th scene of the training split.
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        dataset: Dataset: dexycb, synthetic, or auto.
        physics: Physics engine: exact or fast.
        out: Image file of the plot to write.
        results: Folder for results, from which an interrupted run continues; default: none.
        workers: Number of worker processes; default: one per core.
    """

    risks: str = "0,0.25,0.5,0.75,1"
    setup: str = "s0"
    stride: int = 10
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    out: str | None = None
    results: str | None = None
    workers: int | None = None


def play(risk: float, args: Args) -> list[EpisodeResult]:
    """Return the episodes of the receiver `reactive` with a value of its option `risk`."""
    data = open_dataset(args.dataset, args.data_dir)
    episodes: list[EpisodeResult] = []
    for split, stride in (("val", 1), ("train", args.stride)):
        report = benchmark(
            args.setup,
            split,
            f"reactive:risk={risk}",
            scenes=data.list_scenes(args.setup, split)[::stride],
            data_dir=args.data_dir,
            dataset=args.dataset,
            physics=args.physics,
            out=None if args.results is None else Path(args.results) / f"{risk}-{split}",
            workers=args.workers,
        )
        episodes += report.episodes
    return episodes


def row(risk: float, episodes: list[EpisodeResult]) -> list[str]:
    """Return the cells of the table row of a value of `risk`."""
    n, scores = len(episodes), [episode.speed_score for episode in episodes]
    succeeded = sum(episode.success for episode in episodes)
    low, high = compute_mean_interval(scores) or (0.0, 0.0)
    mean = sum(scores) / n
    others = [f"{100 * sum(bool(episode.status & flag) for episode in episodes) / n:.1f}" for flag in FLAGS]
    return [
        f"{risk:g}",
        format_percent_rate(succeeded, n),
        *others,
        f"{100 * mean:.1f} ({100 * low:.1f} to {100 * high:.1f})",
    ]


def draw(played: dict[float, list[EpisodeResult]], path: Path, heading: str) -> None:
    """Plot success rate and average success (AS) over the option `risk`."""
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    risks = list(played)
    for label, values, intervals in (
        ("success", *_successes(played)),
        ("AS (success and speed in one)", *_scores(played)),
    ):
        below = [value - low for value, (low, _) in zip(values, intervals, strict=True)]
        above = [high - value for value, (_, high) in zip(values, intervals, strict=True)]
        axes.errorbar(risks, values, [below, above], marker="o", capsize=3, label=label)
    axes.set(xlabel="risk", ylabel="%", title=heading.replace("replay, ", "replay,\n"), ylim=(0, 102))
    axes.title.set_fontsize(9)
    axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=130)


def _successes(played: dict[float, list[EpisodeResult]]) -> tuple[list[float], list[tuple[float, float]]]:
    counts = [(sum(e.success for e in episodes), len(episodes)) for episodes in played.values()]
    percents = [compute_wilson_interval(*count) for count in counts]
    return [100 * k / n for k, n in counts], [(100 * low, 100 * high) for low, high in percents]


def _scores(played: dict[float, list[EpisodeResult]]) -> tuple[list[float], list[tuple[float, float]]]:
    scores = [[100 * e.speed_score for e in episodes] for episodes in played.values()]
    return [sum(s) / len(s) for s in scores], [compute_mean_interval(s) or (0.0, 0.0) for s in scores]


def main(args: Args) -> None:
    played = {risk: play(risk, args) for risk in map(float, args.risks.split(","))}
    data = open_dataset(args.dataset, args.data_dir)
    count = len(next(iter(played.values())))
    heading = (
        f"reactive, wait 0, {args.physics} physics, giver replay, {data.name}, "
        f"{args.setup} val and every {args.stride}th of train, {count} episodes"
    )
    print(f"{heading}; 95 % intervals (Wilson; bootstrap for AS).")
    names = ["risk", "success %", *(f"{flag.label} %" for flag in FLAGS), "AS %"]
    print(format_table(names, [row(risk, episodes) for risk, episodes in played.items()]))
    if args.out is not None:
        draw(played, Path(args.out), heading)


if __name__ == "__main__":
    main(tyro.cli(Args))
