"""Compare success rates and outcomes of receivers between the physics engines.

    python experiments/analysis/physics_table.py --data-dir DIR --out runs/physics

The script evaluates every receiver on the same scenes with every engine, and prints success rates and the
share of scenes with the same outcome as in exact physics. The output folder gets a result folder
for each evaluation, from which an interrupted run continues, the table `physics.md` and a plot of
it, `physics.png`. Receivers with camera observations use the robot `panda_camera` and the renderer
of the engine.
"""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from handover_marl import EvaluationConfig, ExecutionConfig
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.comparison import Agreement
from handover_marl.evaluation.config import resolve_config
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.statistics import compute_wilson_interval
from handover_marl.evaluation.reports.tables import format_percent_rate, format_table
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.policies.reference import parse_policy
from handover_marl.simulation.engines import EXACT, PHYSICS

NAME = "physics"


@dataclass(frozen=True)
class Args(SetupArgs):
    """Options of the comparison of receivers between physics engines.

    Attributes:
        receivers: Names of the receivers, with options if there are any.
        giver: Name of the giver.
        physics: Physics engines to compare; the first must be exact.
        split: Split of the setup: train or val; the test split is for final results.
        stride: Use every n-th scene of the split.
        workers: Number of worker processes; default: one per core.
        out: Folder for results, table and plot.
    """

    receivers: tuple[str, ...] = ("hold", "yang2021", "omg", "omg_hand_aware", "reactive", "vision")
    giver: str = "replay"
    physics: tuple[str, ...] = PHYSICS
    split: str = "val"
    stride: int = 1
    workers: int | None = None
    out: Path = Path("runs/physics")


def main(args: Args) -> Path:
    args = args.resolve_setup()
    rows = {}
    for receiver in args.receivers:
        rows[receiver] = {physics: evaluate_receiver(args, receiver, physics) for physics in args.physics}
    report = format_report(args, rows)
    write_atomically(args.out / f"{NAME}.md", report.encode())
    write_atomically(args.out / f"{NAME}.png", draw_success_rates(args, rows))
    print(report)
    return args.out / f"{NAME}.md"


def evaluate_receiver(args: Args, receiver: str, physics: str) -> Report:
    """Return the report of an evaluation of one receiver with one physics engine."""
    run = EvaluationConfig(args.setup, args.split, None, args.dataset, args.data_dir, physics, args.giver, receiver)
    if parse_policy("receiver", receiver).policy_class.obs_mode != "state":
        run = replace(run, robot=PANDA_CAMERA)
    scenes = resolve_config(run)[0].scenes or ()
    run = replace(run, scenes=scenes[:: args.stride])
    folder = re.sub(r"[^\w.@=,+-]", "_", f"{receiver}-{physics}")
    return evaluate_pair(run, execution=ExecutionConfig(workers=args.workers, out=str(args.out / folder)))


def format_report(args: Args, rows: dict[str, dict[str, Report]]) -> str:
    """Return a table of success rates and shares of equal outcomes, with a caption, as Markdown.

    Args:
        args: Options of the script.
        rows: Reports of each receiver, by name of the receiver; the reports are indexed by physics engine.
    """
    cells = []
    for receiver, reports in rows.items():
        rates = [format_success_rate(report) for report in reports.values()]
        agreements = [
            format_agreement(reports[EXACT], reports[kind])
            for kind in args.physics
            if kind != EXACT and EXACT in reports
        ]
        cells.append([receiver, *rates, *agreements])
    others = [kind for kind in args.physics if kind != EXACT] if EXACT in args.physics else []
    header = ["receiver", *(f"{kind}, success %" for kind in args.physics), *(f"{kind} as exact %" for kind in others)]
    any_report = next(report for reports in rows.values() for report in reports.values())
    count = len(any_report.episodes)
    return (
        f"{args.setup} {args.split}, {count} episodes each, giver {args.giver}, {any_report.data_label}, version "
        f"{any_report.metadata.version}; Wilson's 95 % intervals. As exact: episodes that end alike.\n\n"
        f"{format_table(header, cells)}\n"
    )


def format_success_rate(report: Report) -> str:
    """Return the success rate of a report with its 95 % interval (%), as text."""
    return format_percent_rate(report.count(EpisodeStatus.SUCCESS), len(report.episodes))


def format_agreement(exact: Report, other: Report) -> str:
    """Return the share of episodes (%) with the same outcome in two reports of the same scenes.

    Args:
        exact: Report of exact physics.
        other: Report of another physics engine.

    Returns:
        Share with its 95 % interval, as text.
    """
    agreement = Agreement(exact, other)
    return format_percent_rate(agreement.n_same_outcome, len(exact.episodes))


def draw_success_rates(args: Args, rows: dict[str, dict[str, Report]]) -> bytes:
    """Return a PNG image of the success rates of all receivers with all physics engines.

    Args:
        args: Options of the script.
        rows: Reports of each receiver, by name of the receiver; the reports are indexed by physics engine.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 0.6 * len(rows) + 1.4), layout="constrained")
    axes = figure.add_subplot()
    for number, physics in enumerate(args.physics):
        rates, lows, highs = np.array([compute_success_interval(reports[physics]) for reports in rows.values()]).T
        levels = np.arange(len(rows)) + 0.2 * (number - (len(args.physics) - 1) / 2.0)
        axes.errorbar(rates, levels, xerr=[rates - lows, highs - rates], fmt="o", ms=4, capsize=2, label=physics)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    count = next(len(report.episodes) for reports in rows.values() for report in reports.values())
    axes.set_xlabel(f"success %, {args.setup} {args.split}, {count} episodes each, giver {args.giver}, 95 % intervals")
    figure.legend(loc="outside upper right", ncols=len(args.physics), fontsize=8)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=150)
    return drawn.getvalue()


def compute_success_interval(report: Report) -> Sequence[float]:
    """Return the success rate of a report, and the lower and upper end of its 95 % interval (%)."""
    n_successes, count = report.count(EpisodeStatus.SUCCESS), len(report.episodes)
    return [100.0 * value for value in (n_successes / count, *compute_wilson_interval(n_successes, count))]


if __name__ == "__main__":
    main(tyro.cli(Args))
