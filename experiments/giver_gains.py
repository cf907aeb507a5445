"""What adaptive givers do for a receiver, on scenes that the trained one has not seen.

    python experiments/giver_gains.py --data-dir DIR --out results/gains
    python experiments/giver_gains.py --data-dir DIR --parts test --out results/gains-test

Plays the validation split and the held-out tenth of the training split (s0: 36 and 72 scenes), or the test split,
with every giver, and prints outcomes and the gains over the first giver, paired by scene. With --out an interrupted
run goes on, and the table is written to `gains.md`.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.benchmarking.fluency_tables import FLUENCY_NOTE, fluency_header, fluency_row
from handover_marl.benchmarking.runner import evaluate_pair
from handover_marl.benchmarking.statistics import paired_difference
from handover_marl.benchmarking.tables import percent_gain, percent_rate, table
from handover_marl.datasets import open_dataset
from handover_marl.files import write_atomically
from handover_marl.policies.reference import policy_reference
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.training.run_folder import held_out_scenes

FLAGS = (EpisodeStatus.SUCCESS, EpisodeStatus.HUMAN_CONTACT, EpisodeStatus.OBJECT_DROP, EpisodeStatus.TIMEOUT)


@dataclass(frozen=True)
class Args:
    """What to play.

    Attributes:
        givers: Names of givers or `learned:FILE`, with commas; gains are told over the first.
        receiver: Name of the receiver.
        setup: Official setup, s0 to s3.
        parts: What to play, with commas: val, heldout (every tenth scene of train) and test.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: exact or fast.
        out: Folder for results and table.
        workers: Processes to play scenes in; default: one a core.
    """

    givers: str = "replay,cooperative,learned"
    receiver: str = "yang2021"
    setup: str = "s0"
    parts: str = "val,heldout"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "exact"
    out: str | None = None
    workers: int | None = None


def play(giver: str, args: Args) -> list[EpisodeResult]:
    data = open_dataset(args.dataset, args.data_dir)
    # Policies of one file name must not share a folder.
    label = policy_reference("giver", giver).resolved(data).label
    episodes: list[EpisodeResult] = []
    for part in args.parts.split(","):
        split = "train" if part == "heldout" else part
        report = evaluate_pair(
            giver,
            args.receiver,
            args.setup,
            split,
            scenes=held_out_scenes(data.split(args.setup, "train")) if part == "heldout" else None,
            data_dir=args.data_dir,
            dataset=args.dataset,
            physics=args.physics,
            out=None if args.out is None else Path(args.out) / f"{label.replace(':', '_')}-{part}",
            workers=args.workers,
        )
        episodes += report.episodes
    return episodes


def outcomes(played: dict[str, list[EpisodeResult]]) -> str:
    rows = []
    for giver, episodes in played.items():
        counts = [sum(bool(episode.status & flag) for episode in episodes) for flag in FLAGS]
        n = len(episodes)
        rows.append([giver, n, *(percent_rate(count, n) for count in counts)])
    return table(["giver", "episodes", *(f"{flag.label} %" for flag in FLAGS)], rows)


def gains(played: dict[str, list[EpisodeResult]]) -> str:
    first, *others = played
    rows = []
    for giver in others:
        cells = [
            paired_difference(*([bool(e.status & flag) for e in played[name]] for name in (giver, first)))
            for flag in FLAGS
        ]
        rows.append([f"{giver} less {first}", *map(percent_gain, cells)])
    return table(["points, paired by scene", *(flag.label for flag in FLAGS)], rows)


def main(args: Args) -> None:
    played = {giver: play(giver, args) for giver in args.givers.split(",")}
    data = open_dataset(args.dataset, args.data_dir).name
    heading = (
        f"Receiver {args.receiver}, {args.physics} physics, {data}, {args.setup} "
        f"{args.parts.replace(',', ' and ')} (heldout: every tenth scene of train); "
        "95 % intervals (Wilson; Agresti and Min for paired differences)."
    )
    fluency = table(["giver", *fluency_header()], [[name, *fluency_row(played[name])] for name in played])
    text = "\n\n".join([heading, outcomes(played), gains(played), fluency, FLUENCY_NOTE])
    print(text)
    if args.out is not None:
        write_atomically(Path(args.out) / "gains.md", text + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
