"""Ablations of the receiver `vision`: retrained without each component, success in one table.

    python experiments/training/vision_ablations.py --data-dir DIR --out runs/ablations

The script trains the complete network, and one without each component, on half of a training split with the
same camera views. Each network is evaluated in fast physics on the validation split and on scenes
of the training split that are not trained on; the complete one also with camera noise. The folder
gets a run and results per variant, from which an interrupted command continues, and the table
`ablations.md`. The script needs the extras `train`, `plot`, `planning` and `vision`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
import train_vision
import tyro

from handover_marl import CameraNoise, benchmark
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.statistics import compute_paired_difference
from handover_marl.evaluation.reports.tables import (
    NO_VALUE,
    format_percent_difference,
    format_percent_rate,
    format_table,
)
from handover_marl.execution.files import write_atomically
from handover_marl.learning.imitation.vision.training import (
    GraspMetrics,
    GraspTrainingConfig,
    ViewBatches,
    compute_grasp_metrics,
)
from handover_marl.learning.imitation.vision.view_files import read_views
from handover_marl.learning.networks.grasp_network import GraspNetwork
from handover_marl.learning.networks.weights import read_network_weights
from handover_marl.learning.training.run_folder import (
    select_held_out_scenes,
    select_training_scenes,
)

FULL = "complete network"


@dataclass(frozen=True)
class Variant:
    """Variant of the training of `vision`, or of the camera noise in its evaluation.

    Attributes:
        folder: Name of its folder.
        training: Arguments of `train_vision.py` with other values than for the complete network.
        camera: Noise of the wrist camera in the evaluation; None for no noise.
    """

    folder: str
    training: dict[str, Any] = field(default_factory=dict)
    camera: CameraNoise | str | None = None


# By label in the table.
VARIANTS = {
    FULL: Variant("complete_network"),
    "hand points removed": Variant("no_hand_points", {"use_hand_points": False}),
    "PointNet instead of PointNet++": Variant("PointNet", {"use_groups": False}),
    "auxiliary losses removed": Variant("no_auxiliary_losses", {"auxiliary": 0.0}),
    "one DAgger round after half of the gradient updates": Variant("one_DAgger_round", {"rounds": 1}),
    "112 x 112 pixels instead of 224 x 224": Variant(
        "112_x_112_pixels", camera=CameraNoise(depth_noise_std=0.0, edge_dropout=0.0, latency=0.0, pixel_stride=2)
    ),
    '`camera_noise="realsense"`': Variant("realsense", camera="realsense"),
}


@dataclass(frozen=True)
class Args(train_vision.VisionArgs):
    """Arguments of the ablations of `vision`.

    Attributes:
        out: Folder of all runs.
        unseen_scenes: Number of evaluated scenes of the training split that are not trained on.
    """

    updates: int = 1500
    round_stride: int = 6
    stride: int = 2
    out: Path = Path("runs/ablations")
    unseen_scenes: int = 72


@dataclass(frozen=True)
class VariantResult:
    """Results of one variant, which make a row of the table.

    Attributes:
        reports: Reports of the evaluations on the validation split and on scenes of the training
            split that the network was not trained on.
        metrics: Accuracy of predicted grasps on held-out views.
    """

    reports: tuple[Report, ...]
    metrics: GraspMetrics

    def list_successes(self) -> list[bool]:
        """Return one flag for each scene of both reports: whether its episode succeeded."""
        return [bool(one.status & EpisodeStatus.SUCCESS) for report in self.reports for one in report.episodes]


def main(args: Args) -> Path:
    args = args.resolve_setup()
    rows = {}
    for name, variant in VARIANTS.items():
        rows[name] = evaluate_variant(args, name, variant)
        # Rewritten after every variant, so that partial results can be read.
        write_atomically(args.out / "ablations.md", format_page(args, rows))
    print(format_page(args, rows))
    return args.out / "ablations.md"


def evaluate_variant(args: Args, name: str, variant: Variant) -> VariantResult:
    """Train a variant, unless its network exists, and return the results of its evaluation.

    Args:
        args: Arguments of the ablations.
        name: Name of the variant.
        variant: The variant.
    """
    trained = next(other for other, it in VARIANTS.items() if it.training == variant.training)
    weights = train_vision.main(make_training_args(args, trained))
    data = args.open_dataset(args.robot)
    whole = data.list_scenes(args.setup, "train")
    scenes = whole[:: args.stride]
    used = set(select_training_scenes(scenes))
    val = select_scenes_evenly(data.list_scenes(args.setup, "val"), args.val_scenes)
    unseen = select_scenes_evenly([scene for scene in whole if scene not in used], args.unseen_scenes)
    reports = tuple(
        evaluate_weights(args, name, weights, split, chosen) for split, chosen in (("val", val), ("train", unseen))
    )
    views = ViewBatches(read_views(select_held_out_scenes(scenes), args.out / "views"), torch.device("cpu"))
    network, _ = read_network_weights(weights, GraspNetwork)
    return VariantResult(reports, compute_grasp_metrics(network, views, GraspTrainingConfig()))


def get_variant_folder(args: Args, name: str, part: str) -> Path:
    """Return the subfolder `part` of a variant's folder."""
    return args.out / VARIANTS[name].folder / part


def make_training_args(args: Args, name: str) -> train_vision.Args:
    """Return the arguments of a variant's training."""
    shared = {part.name: getattr(args, part.name) for part in fields(train_vision.VisionArgs)}
    options = {"rounds": 0, "round_views": args.views, "shared_views": str(args.out / "views"), "resume": True}
    return train_vision.Args(
        out=str(get_variant_folder(args, name, "training")), **shared | options | VARIANTS[name].training
    )


def evaluate_weights(args: Args, name: str, weights: Path, split: str, scenes: Sequence[int]) -> Report:
    """Return the report of an evaluation of a network on some scenes in fast physics.

    Args:
        args: Arguments of the ablations.
        name: Name of the variant, which determines the camera noise.
        weights: Weight file of the network.
        split: Split of the scenes.
        scenes: Scene numbers.
    """
    return benchmark(
        args.setup,
        split,
        f"vision:weights={weights}",
        scenes=scenes,
        dataset=args.dataset,
        data_dir=args.data_dir,
        robot=args.robot,
        physics="fast",
        camera_noise=VARIANTS[name].camera,
        workers=args.workers,
        out=get_variant_folder(args, name, split),
    )


def format_page(args: Args, rows: dict[str, VariantResult]) -> str:
    """Return the table of all variants with a caption, as Markdown text.

    Args:
        args: Arguments of the ablations.
        rows: Results by name of the variant.
    """
    full, cells = rows[FULL], []
    for name, this in rows.items():
        difference = compute_paired_difference(this.list_successes(), full.list_successes())
        gain = "" if this is full else format_percent_difference(difference)
        rates = [
            format_percent_rate(report.count(EpisodeStatus.SUCCESS), len(report.episodes)) for report in this.reports
        ]
        found = f"{100 * this.metrics.within_2cm:.0f}" if VARIANTS[name].camera is None else NO_VALUE
        cells.append([name, *rates, gain, found])
    header = ["training", "val, success %", "unseen, success %", "gain over the first row, points", "2 cm %"]
    val, unseen = full.reports
    return (
        f"`vision` after {args.updates} updates on every {args.stride}. scene of {args.setup} train, seed {args.seed}; "
        f"{len(val.episodes)} scenes of val and {len(unseen.episodes)} of train that no network was trained on "
        f"(unseen), wait 0, giver replay, {val.data_label}, {args.robot}, version {val.metadata.version}; 95 % "
        "intervals (Wilson; Agresti and Min for differences paired by scene). 2 cm: share of held-out views "
        f"({full.metrics.views}) whose best predicted grasp is within 2 cm of a good one, rotation included.\n\n"
        f"{format_table(header, cells, max_width=200)}\n"
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
