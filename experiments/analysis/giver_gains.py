"""Measure the gains of adaptive givers for a receiver.

    python experiments/analysis/giver_gains.py --data-dir DIR --out results/gains
    python experiments/analysis/giver_gains.py --data-dir DIR --parts test --out results/gains-test

The script evaluates every giver on the val split and the held-out tenth of the train split (s0: 36 and 72
scenes), or on the test split, and prints outcomes and gains over the first giver, paired by scene.
With --out an interrupted run resumes, and the table is written to `gains.md`.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.reports.episode_tables import FLUENCY_NOTE, format_fluency_row
from handover_marl.evaluation.reports.statistics import compute_paired_difference
from handover_marl.evaluation.reports.tables import (
    FLUENCY,
    format_percent_difference,
    format_percent_rate,
    format_table,
)
from handover_marl.evaluation.results.episode_result import EpisodeResult
from handover_marl.execution.files import write_atomically
from handover_marl.learning.training.run_folder import select_held_out_scenes
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.policies.reference import parse_policy

FLAGS = (EpisodeStatus.SUCCESS, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the comparison of givers on the same scenes.

    Attributes:
        givers: Names of givers or `learned:FILE`, with commas; gains are relative to the first.
        receiver: Name of the receiver.
        parts: Scenes to evaluate, with commas: val, heldout (every tenth scene of train) and test.
        out: Folder for results and the table `gains.md`; default: no files are written.
    """

    givers: str = "replay,cooperative,learned"
    receiver: str = "yang2021"
    parts: str = "val,heldout"
    physics: str = "exact"
    out: str | None = None


def evaluate_giver(giver: str, args: Args) -> list[EpisodeResult]:
    data = args.open_dataset()
    # Policies of one file name must not share a folder.
    label = parse_policy("giver", giver).resolve(data).label
    episodes: list[EpisodeResult] = []
    for part in args.parts.split(","):
        split = "train" if part == "heldout" else part
        report = evaluate_pair(
            giver,
            args.receiver,
            split=split,
            scenes=select_held_out_scenes(data.list_scenes(args.setup, "train")) if part == "heldout" else None,
            out=None if args.out is None else Path(args.out) / f"{label.replace(':', '_')}-{part}",
            **args.evaluation_options,
        )
        episodes += report.episodes
    return episodes


def format_outcomes(episodes_by_giver: dict[str, list[EpisodeResult]]) -> str:
    rows = []
    for giver, episodes in episodes_by_giver.items():
        counts = [sum(bool(episode.status & flag) for episode in episodes) for flag in FLAGS]
        n = len(episodes)
        rows.append([giver, n, *(format_percent_rate(count, n) for count in counts)])
    return format_table(["giver", "episodes", *(f"{flag.label} %" for flag in FLAGS)], rows)


def format_gains(episodes_by_giver: dict[str, list[EpisodeResult]]) -> str:
    first, *others = episodes_by_giver
    rows = []
    for giver in others:
        cells = [
            compute_paired_difference(
                *([bool(e.status & flag) for e in episodes_by_giver[name]] for name in (giver, first))
            )
            for flag in FLAGS
        ]
        rows.append([f"{giver} less {first}", *map(format_percent_difference, cells)])
    return format_table(["points, paired by scene", *(flag.label for flag in FLAGS)], rows)


def main(args: Args) -> None:
    args = args.resolve_setup()
    episodes_by_giver = {giver: evaluate_giver(giver, args) for giver in args.givers.split(",")}
    data = args.open_dataset().name
    heading = (
        f"Receiver {args.receiver}, {args.physics} physics, {data}, {args.setup} "
        f"{args.parts.replace(',', ' and ')} (heldout: every tenth scene of train); "
        "95 % intervals (Wilson; Agresti and Min for paired differences)."
    )
    fluency = format_table(
        ["giver", *(column.title for column in FLUENCY)],
        [[name, *format_fluency_row(episodes_by_giver[name])] for name in episodes_by_giver],
    )
    text = "\n\n".join(
        [heading, format_outcomes(episodes_by_giver), format_gains(episodes_by_giver), fluency, FLUENCY_NOTE]
    )
    print(text)
    if args.out is not None:
        write_atomically(Path(args.out) / "gains.md", text + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
