"""Measure how much a giver would gain by the best of K random offers (ways to hold out the object) in each scene.

    python experiments/measure_headroom.py --data-dir DIR --receivers yang2021 omg --out results/headroom

For each quantity of an offer, a giver of the library draws this quantity and varies nothing else. All pairs play the
same scenes with the seeds 0 to `draws` - 1. For several K, the script prints the share of scenes in which at least one
of K draws succeeds, as mean over all subsets of K draws. The result folders go to `OUT`; the same command continues an
interrupted run.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from scipy.special import comb

import handover_marl
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.reports.tables import estimate_mean, format_table
from handover_marl.learning.training.scene_arguments import SetupArgs

#: Givers that draw one quantity of an offer at random for each episode.
QUANTITIES = {
    "place": "displaced:angle=0",
    "turn": "displaced:distance=0",
    "place and turn": "displaced",
    "pace": "hurried:min_rate=-0.5,max_rate=1.0",
    "moment of release": "early_release",
}


@dataclass(frozen=True)
class Args(SetupArgs):
    """Options of the measurement.

    Attributes:
        receivers: Receivers, with options.
        quantities: Quantities of the offers, keys of `QUANTITIES`.
        split: Split of the scenes: train or val.
        n_scenes: Number of scenes, evenly chosen.
        draws: Number of offers for each scene.
        physics: Physics engine: fast, exact or mujoco.
        workers: Number of worker processes; default: one per core.
        out: Folder of the results.
        figure: Picture to write, e.g. headroom.svg; it needs the extra `plot`.
    """

    receivers: tuple[str, ...] = ("yang2021",)
    quantities: tuple[str, ...] = tuple(QUANTITIES)
    split: str = "val"
    n_scenes: int = 36
    draws: int = 32
    physics: str = "mujoco"
    workers: int | None = None
    out: Path = Path("results/headroom")
    figure: Path | None = None


def compute_best_of(successes: npt.NDArray[np.bool_], k: int) -> npt.NDArray[np.float64]:
    """Return for each of s scenes the probability (s,) that at least one of k draws of an offer succeeds.

    The k draws are chosen at random, without replacement, from the n draws with the outcomes `successes` (s, n).
    """
    n, failures = successes.shape[1], (~successes).sum(axis=1)
    best: npt.NDArray[np.float64] = 1.0 - comb(failures, k) / comb(n, k)
    return best


def play(args: Args, receiver: str, giver: str, folder: str) -> npt.NDArray[np.bool_]:
    """Return the successes (s, n) of n draws of a giver in each of s scenes; store the results in `folder`."""
    scenes = select_scenes_evenly(args.open_dataset().list_scenes(args.setup, args.split), args.n_scenes)
    columns = []
    for seed in range(args.draws):
        report = handover_marl.evaluate_pair(
            giver,
            receiver,
            split=args.split,
            scenes=scenes,
            seed=seed,
            out=str(args.out / folder / str(seed)),
            progress=False,
            physics=args.physics,
            workers=args.workers,
            dataset=args.dataset,
            data_dir=args.data_dir,
            setup=args.setup,
        )
        columns.append([episode.success for episode in report.episodes])
    successes: npt.NDArray[np.bool_] = np.array(columns, dtype=bool).T
    return successes


def main(args: Args) -> dict[tuple[str, str], npt.NDArray[np.bool_]]:
    """Evaluate all pairs, and print the success of the best of K draws; return all successes as for `draw_figure`."""
    args = args.resolve_setup()
    numbers = [k for k in (1, 2, 4, 8, 16, 32) if k <= args.draws]
    found, rows = {}, []
    for receiver in args.receivers:
        for quantity in args.quantities:
            folder = f"{receiver}-{quantity}".replace(" ", "_").replace(":", "_")
            successes = found[receiver, quantity] = play(args, receiver, QUANTITIES[quantity], folder)
            estimates = [estimate_mean(compute_best_of(successes, k).tolist()) for k in numbers]
            rows.append([receiver, quantity, *(one.format() for one in estimates)])
    print(format_table(["receiver", "offers differ in", *(f"best of {k}, success %" for k in numbers)], rows))
    n_scenes = len(next(iter(found.values())))
    print(f"{n_scenes} scenes of {args.setup} {args.split}, {args.open_dataset().name}, {args.physics} physics")
    if args.figure is not None:
        draw_figure(found, numbers, args.figure)
    return found


def draw_figure(found: dict[tuple[str, str], npt.NDArray[np.bool_]], numbers: list[int], path: Path) -> None:
    """Plot the success of the best of K offers against K, with a curve for each receiver and quantity that varies.

    Args:
        found: Successes (scenes, draws) by receiver and key of `QUANTITIES`.
        numbers: Values of K.
        path: Image file to write.
    """
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6.5, 4.0), layout="constrained")
    for (receiver, quantity), successes in found.items():
        rates = [100 * compute_best_of(successes, k).mean() for k in numbers]
        axes.plot(numbers, rates, "o-", label=f"{receiver}, {quantity}")
    axes.set_xscale("log", base=2)
    axes.set_xticks(numbers, [str(k) for k in numbers])
    axes.set_xlabel("number of random offers")
    axes.set_ylabel("success of the best offer (%)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
