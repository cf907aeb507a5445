"""Train the grasp network of the receiver `vision`.

The script needs the extras `train`, `planning` and `vision`.

    python experiments/training/train_vision.py --data-dir DIR --out runs/vision

The script renders views of a training split from random poses of the wrist camera, validates the objects'
grasps in simulation if that was not done yet, and trains the network to predict good grasps. With
`--extra-datasets generated:n=1000,seed=7`, the training scenes of other data sets are used too. In
later rounds, views recorded while the receiver uses the trained network are added (DAgger). After
every round the receiver is evaluated on the validation split in fast physics. The folder gets
`vision.npz`, the best network (`--receiver vision:weights=runs/vision/vision.npz`),
TensorBoard logs, the views, and a checkpoint, from which `--resume` continues.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.progress import track

from handover_marl.datasets import open_dataset
from handover_marl.learning.imitation.run import ImitationArgs, ImitationRun
from handover_marl.learning.imitation.vision.training import (
    GraspTrainer,
    GraspTrainingConfig,
    ViewBatches,
    compute_grasp_metrics,
)
from handover_marl.learning.imitation.vision.view_files import ViewDatasetConfig, generate_views, read_views
from handover_marl.learning.imitation.vision.views import GraspViews
from handover_marl.learning.networks.grasp_network import GraspNetwork
from handover_marl.learning.training.run_folder import select_held_out_scenes, select_training_scenes

# Updates between two records of losses and of metrics, and number of held-out views for the metrics.
LOSS_INTERVAL, METRICS_INTERVAL, N_HELD_OUT = 250, 1000, 1500


@dataclass(frozen=True)
class Args(ImitationArgs):
    """Arguments of the training of the grasp network of `vision`.

    Attributes:
        setup: Official setup, s0 to s3, or a setup of other data; default: the first of the dataset.
        robot: Robot model: panda or panda_camera.
        views: Number of rendered camera views per scene in the first round.
        round_views: Number of views per scene in a later round.
        round_stride: Use every n-th scene in a later round, with another offset in each round.
        stride: Use every n-th scene of the training split.
        extra_datasets: Other data sets, whose training scenes (of their first setup) are used too; `data_dir` is not
            theirs.
        views_seed: Seed of the first round's views; default: `seed`.
    """

    out: str = "runs/vision"
    setup: str | None = None
    robot: str = "panda_camera"
    views: int = 80
    round_views: int = 60
    round_stride: int = 3
    stride: int = 1
    extra_datasets: tuple[str, ...] = ()
    views_seed: int | None = None


def load_views(args: Args, run: ImitationRun, dataset: str, scenes: Sequence[int], number: int) -> GraspViews:
    """Return the views of scenes of a data set in a round; generate missing ones."""
    folder = run.folder / "views" / f"round_{number}"
    data_dir = args.data_dir
    if dataset != args.dataset:
        folder, data_dir = folder / re.sub(r"\W+", "-", dataset), None
    seed = args.seed if args.views_seed is None or number else args.views_seed
    count, weights = (args.round_views, str(run.latest)) if number else (args.views, None)
    config = ViewDatasetConfig(dataset, data_dir, args.robot, count, seed, weights=weights)
    generate_views(config, scenes, folder, args.workers or os.cpu_count() or 1)
    return read_views(scenes, folder)


def train(trainer: GraspTrainer, run: ImitationRun, views: ViewBatches, held_out: ViewBatches, end: int) -> None:
    """Run the gradient updates of a round; log losses, and metrics on held-out views."""
    for done in track(range(trainer.done + 1, end + 1), description=f"updates up to {end}"):
        losses = trainer.update(views)
        if done % LOSS_INTERVAL == 0 or done == end:
            for name, value in losses._asdict().items():
                run.writer.add_scalar(f"loss/{name}", float(value), done)
        if done % METRICS_INTERVAL == 0 or done == end:
            metrics = compute_grasp_metrics(trainer.network, held_out, trainer.config)
            for name, value in vars(metrics).items():
                run.writer.add_scalar(f"held out/{name}", value, done)
            run.save()


def main(args: Args) -> Path:
    """Train in all rounds; return the path of the best network's weights."""
    data = args.open_dataset(args.robot)
    setup = data.resolve_setup(args.setup)
    scenes = data.list_scenes(setup, "train")[:: args.stride]
    training = {args.dataset: select_training_scenes(scenes)}
    for name in args.extra_datasets:
        extra = open_dataset(name, robot=args.robot)
        training[name] = extra.list_scenes(extra.resolve_setup(None), "train")[:: args.stride]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(args.seed)
    trainer = GraspTrainer(GraspNetwork(), GraspTrainingConfig(), args.updates, args.seed, device)
    run = ImitationRun(args, "vision", setup, args.robot, trainer.get_state, trainer.restore, ("updates",))
    others = load_views(args, run, args.dataset, select_held_out_scenes(scenes), 0)
    held_out = ViewBatches(GraspViews._make(part[:: -(-len(part) // N_HELD_OUT)] for part in others), device)
    views: list[GraspViews] = []
    for number, end in enumerate(args.update_counts):
        for name, ids in training.items():
            chosen = ids[number % args.round_stride :: args.round_stride] or ids if number else ids
            views.append(load_views(args, run, name, chosen, number))
        if trainer.done < end:
            joined = GraspViews(*(np.concatenate(arrays) for arrays in zip(*views, strict=True)))
            train(trainer, run, ViewBatches(joined, device), held_out, end)
            run.evaluate(trainer.network, trainer.done)
    run.writer.close()
    return run.best


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
