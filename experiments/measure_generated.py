"""Evaluate receivers on generated scenes, and print a table beside their results on s0.

    python experiments/measure_generated.py --receivers yang2021:wait=0 reactive vision --scenes 200

The scenes are the first ones of the test split of each data set. The script evaluates in fast
physics with the giver `replay`. An interrupted run continues. Rows of s0 are the stored evaluations
of `docs/results/data`, in exact physics; they have another data set and are for orientation only.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

import handover_marl
from handover_marl.datasets import open_dataset
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import STATE
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.statistics import compute_wilson_interval
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.policies.reference import parse_policy

OUTCOMES = (
    EpisodeStatus.SUCCESS,
    EpisodeStatus.HUMAN_CONTACT,
    EpisodeStatus.OBJECT_DROP,
    EpisodeStatus.TIMEOUT,
)
EVALUATIONS = Path(__file__).resolve().parents[1] / "docs" / "results" / "data" / "evaluations.json"
HEADER = ("data set", "receiver", "n episodes", "success %", "contact %", "drop %", "timeout %", "exec s", "AS %")


@dataclass(frozen=True)
class Args:
    """Options of the evaluation on generated scenes.

    Attributes:
        receivers: Names of the receivers, with options if there are any.
        datasets: Names of the data sets.
        scenes: Number of test scenes of each data set.
        physics: Physics engine.
        workers: Number of worker processes; default: one per core.
        out: Folder for the result folders.
        evaluate: Whether to evaluate; otherwise the table shows what is stored in `out`.
    """

    receivers: tuple[str, ...] = ("yang2021:wait=0", "reactive", "vision", "omg:wait=0", "gaddpg:wait=0")
    datasets: tuple[str, ...] = ("generated:n=3000,seed=7", "generated:n=3000,seed=7,family=hard")
    scenes: int = 200
    physics: str = "fast"
    workers: int | None = None
    out: Path = Path("results/generated")
    evaluate: bool = True


def measure(dataset: str, receiver: str, args: Args) -> Report | None:
    """Return the report of a receiver on a data set; None if nothing is stored and nothing is to be evaluated."""
    folder = args.out / re.sub(r"\W+", "-", f"{receiver}-{dataset}")
    if not args.evaluate:
        return handover_marl.evaluate(folder) if folder.is_dir() else None
    has_camera = parse_policy("receiver", receiver).policy_class.obs_mode != STATE
    scenes = open_dataset(dataset).list_scenes(None, "test")[: args.scenes]
    return handover_marl.benchmark(
        None,
        "test",
        receiver,
        scenes=scenes,
        dataset=dataset,
        physics=args.physics,
        robot=PANDA_CAMERA if has_camera else PANDA,
        workers=args.workers,
        out=str(folder),
    )


def format_report(dataset: str, receiver: str, report: Report) -> list[str]:
    """Return the cells of the table row of a report."""
    count = len(report.episodes)
    rates = [format_rate(report.count(status), count) for status in OUTCOMES]
    times = [f"{report.time_exec or 0.0:.2f}", f"{100 * report.average_success:.1f}"]
    return [dataset, f"`{receiver}`", str(count), *rates, *times]


def format_rate(count: int, total: int) -> str:
    """Return a rate with its 95 % Wilson interval (%), as text."""
    low, high = compute_wilson_interval(count, total)
    return f"{100 * count / total:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def list_stored_rows(receivers: Sequence[str]) -> Iterator[list[str]]:
    """Yield the rows of the stored evaluations of receivers on the test split of s0."""
    names = {receiver.partition(":")[0] for receiver in receivers}
    for stored in json.loads(EVALUATIONS.read_text()):
        is_s0 = (stored["dataset"], stored["setup"], stored["split"]) == ("dexycb", "s0", "test")
        if is_s0 and stored["receiver"] in names:
            count = stored["episodes"]
            rates = [format_rate(stored[name], count) for name in ("success", "contact", "drop", "timeout")]
            start = [f"DexYCB s0 (wait {stored['wait_s']:g} s, exact physics)", f"`{stored['receiver']}`", str(count)]
            yield [*start, *rates, f"{stored['exec_s']:.2f}", f"{stored['as_percent']:.1f}"]


def main(args: Args) -> None:
    """Evaluate all receivers on all data sets and print the table."""
    rows = []
    for dataset in args.datasets:
        for receiver in args.receivers:
            report = measure(dataset, receiver, args)
            if report is not None:
                rows.append(format_report(dataset, receiver, report))
                print(format_table(HEADER, rows[-1:]), flush=True)
    print(f"\nGiver replay, {args.physics} physics, version {handover_marl.__version__}:\n")
    print(format_table(HEADER, [*rows, *list_stored_rows(args.receivers)]))


if __name__ == "__main__":
    main(tyro.cli(Args))
