"""The same receivers in all kinds of physics: how often each succeeds, and how many scenes end as in exact physics.

    python experiments/physics_table.py --data-dir DIR --out runs/physics

Every receiver plays the same scenes in every kind; the folder gets one of results for each, with which a stopped run
goes on, the table as `physics.md` and a picture of it, `physics.png`. Receivers that see do so with the camera's robot
and the renderer of each kind of physics.
"""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from handover_marl import Execution, Run
from handover_marl.benchmarking.agreement import Agreement
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.benchmarking.statistics import wilson_interval
from handover_marl.benchmarking.tables import percent_rate, table
from handover_marl.datasets.official_files import PANDA_CAMERA
from handover_marl.files import write_atomically
from handover_marl.policies.reference import policy_reference
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.run import resolve
from handover_marl.sim.engines import EXACT, PHYSICS

NAME = "physics"


@dataclass(frozen=True)
class Args:
    """What is played.

    Attributes:
        receivers: Who takes.
        giver: Who gives.
        physics: In which kinds of physics, exact first.
        setup: Official setup, s0 to s3.
        split: train or val; choose nothing on test.
        stride: Every n-th scene.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic or auto.
        workers: Processes; default: one a core.
        out: Folder of results.
    """

    receivers: tuple[str, ...] = ("hold", "yang2021", "omg", "omg_hand_aware", "reactive", "vision")
    giver: str = "replay"
    physics: tuple[str, ...] = PHYSICS
    setup: str = "s0"
    split: str = "val"
    stride: int = 1
    data_dir: str | None = None
    dataset: str = "auto"
    workers: int | None = None
    out: Path = Path("runs/physics")


def main(args: Args) -> Path:
    rows = {}
    for receiver in args.receivers:
        rows[receiver] = {physics: play(args, receiver, physics) for physics in args.physics}
    report = text(args, rows)
    write_atomically(args.out / f"{NAME}.md", report.encode())
    write_atomically(args.out / f"{NAME}.png", picture(args, rows))
    print(report)
    return args.out / f"{NAME}.md"


def play(args: Args, receiver: str, physics: str) -> Report:
    """One receiver in one kind of physics."""
    run = Run(
        setup=args.setup,
        split=args.split,
        dataset=args.dataset,
        data_dir=args.data_dir,
        receiver=receiver,
        giver=args.giver,
        physics=physics,
    )
    if policy_reference("receiver", receiver).kind.sight is not None:
        run = replace(run, robot=PANDA_CAMERA)
    scenes = resolve(run)[0].scenes or ()
    run = replace(run, scenes=scenes[:: args.stride])
    folder = re.sub(r"[^\w.@=,+-]", "_", f"{receiver}-{physics}")
    return evaluate_run(run, Execution(workers=args.workers, out=str(args.out / folder)))


def text(args: Args, rows: dict[str, dict[str, Report]]) -> str:
    """The table, and what it is about."""
    cells = []
    for receiver, reports in rows.items():
        rates = [percent(report) for report in reports.values()]
        alike = [agreed(reports[EXACT], reports[kind]) for kind in args.physics if kind != EXACT and EXACT in reports]
        cells.append([receiver, *rates, *alike])
    others = [kind for kind in args.physics if kind != EXACT] if EXACT in args.physics else []
    header = ["receiver", *(f"{kind}, success %" for kind in args.physics), *(f"{kind} as exact %" for kind in others)]
    some = next(report for reports in rows.values() for report in reports.values())
    count = len(some.episodes)
    return (
        f"{args.setup} {args.split}, {count} episodes each, giver {args.giver}, {some.data_label()}, version "
        f"{some.settings.version}; Wilson's 95 % intervals. As exact: episodes that end alike.\n\n"
        f"{table(header, cells)}\n"
    )


def percent(report: Report) -> str:
    """Success with its interval."""
    return percent_rate(report.count(EpisodeStatus.SUCCESS), len(report.episodes))


def agreed(exact: Report, other: Report) -> str:
    """Episodes that end alike, with their interval."""
    both = Agreement(exact, other)
    return percent_rate(both.n_agreed, len(exact.episodes))


def picture(args: Args, rows: dict[str, dict[str, Report]]) -> bytes:
    """Success of every receiver in every kind of physics, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 0.6 * len(rows) + 1.4), layout="constrained")
    axes = figure.add_subplot()
    for place, physics in enumerate(args.physics):
        points = [interval(reports[physics]) for reports in rows.values()]
        rates, lows, highs = zip(*points, strict=True)
        levels = [number + 0.2 * (place - (len(args.physics) - 1) / 2.0) for number in range(len(rows))]
        below = [rate - low for rate, low in zip(rates, lows, strict=True)]
        above = [high - rate for rate, high in zip(rates, highs, strict=True)]
        axes.errorbar(rates, levels, xerr=[below, above], fmt="o", ms=4, capsize=2, label=physics)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    count = next(len(report.episodes) for reports in rows.values() for report in reports.values())
    axes.set_xlabel(f"success %, {args.setup} {args.split}, {count} episodes each, giver {args.giver}, 95 % intervals")
    figure.legend(loc="outside upper right", ncols=len(args.physics), fontsize=8)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=150)
    return drawn.getvalue()


def interval(report: Report) -> Sequence[float]:
    """Success and the ends of its interval in %."""
    wins, count = report.count(EpisodeStatus.SUCCESS), len(report.episodes)
    return [100.0 * value for value in (wins / count, *wilson_interval(wins, count))]


if __name__ == "__main__":
    main(tyro.cli(Args))
