"""What the parts of `vision` are worth: the same training without each of them, as one table.

    python experiments/vision_ablations.py --data-dir DIR --out runs/ablations

Trains the network on half of a training split, once with everything and once without each part, from the same views;
each then plays the validation split and scenes of the training split that none has learned from, in fast physics and
at once. One network plays through worse cameras, too. The folder gets a training run and results for each, with which
a stopped run goes on, and the table as `ablations.md`. Needs the extras `train`, `plot`, `planning` and `vision`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import train_vision
import tyro

from handover_marl import CameraImperfections, benchmark
from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.statistics import paired_difference
from handover_marl.benchmarking.tables import NO_VALUE, percent_gain, percent_rate, table
from handover_marl.datasets import open_dataset
from handover_marl.files import write_atomically
from handover_marl.imitation.vision.grasp_training import Batches, GraspScores, GraspTrainingConfig, scores
from handover_marl.imitation.vision.grasp_view_files import read_views
from handover_marl.networks.grasp_network import GraspNetwork
from handover_marl.networks.own_weights import read_own_weights
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.training.run_folder import held_out_scenes, spread_scenes, training_scenes

FULL = "everything"


@dataclass(frozen=True)
class Variant:
    """One row.

    Attributes:
        training: What is other in training.
        camera: What is wrong with the camera that it plays with.
    """

    training: dict[str, Any] = field(default_factory=dict)
    camera: CameraImperfections | str | None = None


VARIANTS = {
    FULL: Variant(),
    "hand not seen": Variant({"hand": False}),
    "PointNet": Variant({"groups": False}),
    "no auxiliary losses": Variant({"auxiliary": 0.0}),
    "round of DAgger": Variant({"rounds": 1}),
    "112 x 112 pixels": Variant(camera=CameraImperfections(depth_noise=0.0, edge_drop=0.0, latency=0.0, every=2)),
    "realsense": Variant(camera="realsense"),
}


@dataclass(frozen=True)
class Args:
    """What is trained and played.

    Attributes:
        out: Folder of it all.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        robot: panda or panda_camera.
        seed: Of all trainings.
        steps: Batches of each.
        stride: Every n-th scene of the training split is for training.
        views: Views of a scene.
        round_stride: In a round of DAgger every n-th of these is played.
        val_scenes: Scenes of the validation split to play, and
        unseen_scenes: of the rest of the training split, evenly chosen.
        workers: Processes that take views and play; default: one a core.
    """

    out: Path = Path("runs/ablations")
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    robot: str = "panda_camera"
    seed: int = 0
    steps: int = 1500
    stride: int = 2
    views: int = 80
    round_stride: int = 6
    val_scenes: int = 36
    unseen_scenes: int = 72
    workers: int | None = None


@dataclass(frozen=True)
class Row:
    """What came of a variant: reports on val and on unseen scenes, and how well grasps are told in views held out."""

    reports: tuple[Report, ...]
    scores: GraspScores

    def wins(self) -> list[bool]:
        """Scene by scene, of both."""
        return [bool(one.status & EpisodeStatus.SUCCESS) for report in self.reports for one in report.episodes]


def main(args: Args) -> Path:
    rows = {}
    for name, variant in VARIANTS.items():
        rows[name] = row(args, name, variant)
        # What is there so far can be read while the rest is running.
        write_atomically(args.out / "ablations.md", text(args, rows))
    print(text(args, rows))
    return args.out / "ablations.md"


def row(args: Args, name: str, variant: Variant) -> Row:
    """Train a variant, unless its network is there, and play with it."""
    trained = next(other for other, it in VARIANTS.items() if it.training == variant.training)
    weights = train_vision.main(training(args, trained))
    data = open_dataset(args.dataset, args.data_dir, args.robot)
    whole = data.split(args.setup, "train")
    scenes = whole[:: args.stride]
    learned = set(training_scenes(scenes))
    val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
    unseen = spread_scenes([scene for scene in whole if scene not in learned], args.unseen_scenes)
    reports = tuple(played(args, name, weights, split, some) for split, some in (("val", val), ("train", unseen)))
    views = Batches(read_views(held_out_scenes(scenes), args.out / "views"), torch.device("cpu"))
    return Row(reports, scores(read_own_weights(weights, GraspNetwork)[0], views, GraspTrainingConfig()))


def folder(args: Args, name: str, part: str) -> Path:
    """Where a variant's part goes."""
    return args.out / name.replace(" ", "_") / part


def training(args: Args, name: str) -> train_vision.Args:
    """The arguments of a variant's training."""
    usual = train_vision.Args(
        out=str(folder(args, name, "training")),
        setup=args.setup,
        data_dir=args.data_dir,
        dataset=args.dataset,
        robot=args.robot,
        seed=args.seed,
        steps=args.steps,
        rounds=0,
        views=args.views,
        round_views=args.views,
        round_stride=args.round_stride,
        stride=args.stride,
        val_scenes=args.val_scenes,
        shared_views=str(args.out / "views"),
        workers=args.workers,
        resume=True,
    )
    return replace(usual, **VARIANTS[name].training)


def played(args: Args, name: str, weights: Path, split: str, scenes: Sequence[int]) -> Report:
    """Some scenes, in fast physics and at once."""
    return benchmark(
        args.setup,
        split,
        f"vision:weights={weights}",
        scenes=scenes,
        dataset=args.dataset,
        data_dir=args.data_dir,
        robot=args.robot,
        physics="fast",
        imperfections=VARIANTS[name].camera,
        workers=args.workers,
        out=folder(args, name, split),
    )


def text(args: Args, rows: dict[str, Row]) -> str:
    """The table, and what it is about."""
    full = rows[FULL]
    cells = []
    for name, this in rows.items():
        gain = "" if this is full else percent_gain(paired_difference(this.wins(), full.wins()))
        rates = [percent_rate(report.count(EpisodeStatus.SUCCESS), len(report.episodes)) for report in this.reports]
        found = f"{100 * this.scores.far:.0f}" if VARIANTS[name].camera is None else NO_VALUE
        cells.append([name, *rates, gain, found])
    header = ["training", "val, success %", "unseen, success %", "points over the first", "2 cm %"]
    val, unseen = full.reports
    return (
        f"`vision` after {args.steps} steps on every {args.stride}. scene of {args.setup} train, seed {args.seed}; "
        f"{len(val.episodes)} scenes of val and {len(unseen.episodes)} of train that none learned from (unseen), "
        f"wait 0, giver replay, {val.data_label()}, {args.robot}, version {val.settings.version}; 95 % intervals "
        "(Wilson; Agresti and Min for differences paired by scene). 2 cm: views held out "
        f"({full.scores.views}) in which the grasp told to be best is so near to a good one, turns counted.\n\n"
        f"{table(header, cells)}\n"
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
