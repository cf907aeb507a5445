"""What the option `risk` of the receiver `reactive` trades: success against speed.

    python experiments/risk_curve.py --data-dir DIR --out docs/risk.png

Plays the validation split and every tenth scene of the training split with a row of risks, prints a table with 95 %
intervals and draws it. With --results an interrupted run goes on.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.figure import Figure

from handover_marl import benchmark
from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.statistics import mean_interval, wilson_interval
from handover_marl.benchmarking.tables import percent_rate, table
from handover_marl.datasets import open_dataset
from handover_marl.protocol.status import EpisodeStatus

FLAGS = (EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)


@dataclass(frozen=True)
class Args:
    """What to play.

    Attributes:
        risks: Risks, with commas.
        setup: Official setup, s0 to s3.
        stride: Of the training split every n-th scene.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: exact or fast.
        out: Where the picture goes.
        results: Folder for results.
        workers: Processes to play scenes in; default: one a core.
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
    """The episodes of one risk."""
    data = open_dataset(args.dataset, args.data_dir)
    episodes: list[EpisodeResult] = []
    for split, stride in (("val", 1), ("train", args.stride)):
        report = benchmark(
            args.setup,
            split,
            f"reactive:risk={risk}",
            scenes=data.split(args.setup, split)[::stride],
            data_dir=args.data_dir,
            dataset=args.dataset,
            physics=args.physics,
            out=None if args.results is None else Path(args.results) / f"{risk}-{split}",
            workers=args.workers,
        )
        episodes += report.episodes
    return episodes


def row(risk: float, episodes: list[EpisodeResult]) -> list[str]:
    """A line of the table."""
    n, scores = len(episodes), [episode.speed_score for episode in episodes]
    succeeded = sum(episode.success for episode in episodes)
    low, high = mean_interval(scores) or (0.0, 0.0)
    mean = sum(scores) / n
    others = [f"{100 * sum(bool(episode.status & flag) for episode in episodes) / n:.1f}" for flag in FLAGS]
    return [
        f"{risk:g}",
        percent_rate(succeeded, n),
        *others,
        f"{100 * mean:.1f} ({100 * low:.1f} to {100 * high:.1f})",
    ]


def draw(played: dict[float, list[EpisodeResult]], path: Path, heading: str) -> None:
    """Success and AS over risk."""
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
    percents = [wilson_interval(*count) for count in counts]
    return [100 * k / n for k, n in counts], [(100 * low, 100 * high) for low, high in percents]


def _scores(played: dict[float, list[EpisodeResult]]) -> tuple[list[float], list[tuple[float, float]]]:
    scores = [[100 * e.speed_score for e in episodes] for episodes in played.values()]
    return [sum(s) / len(s) for s in scores], [mean_interval(s) or (0.0, 0.0) for s in scores]


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
    print(table(names, [row(risk, episodes) for risk, episodes in played.items()]))
    if args.out is not None:
        draw(played, Path(args.out), heading)


if __name__ == "__main__":
    main(tyro.cli(Args))
