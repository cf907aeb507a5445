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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from torch.utils.tensorboard import SummaryWriter

from handover_marl import benchmark
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.learning.imitation.vision.training import (
    GraspTrainer,
    GraspTrainingConfig,
    ViewBatches,
    compute_grasp_metrics,
)
from handover_marl.learning.imitation.vision.view_files import ViewDatasetConfig, generate_views, read_views
from handover_marl.learning.imitation.vision.views import GraspViews
from handover_marl.learning.networks.grasp_network import GraspNetwork, GraspNetworkConfig
from handover_marl.learning.networks.weights import write_network_weights
from handover_marl.learning.training.run_folder import (
    CHECKPOINT,
    describe_origin,
    open_run_folder,
    read_checkpoint,
    select_held_out_scenes,
    select_training_scenes,
    summarize_evaluation,
    write_checkpoint,
)
from handover_marl.learning.training.scene_arguments import SetupArgs

WEIGHTS = "vision.npz"
# Updates between two records of losses and of metrics, and number of held-out views for the metrics.
LOSS_INTERVAL, METRICS_INTERVAL, N_HELD_OUT = 250, 1000, 1500


@dataclass(frozen=True)
class VisionArgs(SetupArgs):
    """Arguments of the trainings of the grasp network of `vision`, alone and in ablations.

    Attributes:
        robot: Robot model: panda or panda_camera.
        seed: Seed of all random numbers.
        updates: Total number of gradient updates of a network.
        views: Number of rendered camera views per scene in the first round.
        round_stride: Use every n-th scene in a DAgger round, with another offset in each round.
        stride: Use every n-th scene of the training split.
        val_scenes: Number of validation scenes, evenly chosen.
        workers: Number of worker processes; default: one per core.
    """

    robot: str = "panda_camera"
    seed: int = 0
    updates: int = 12_000
    views: int = 80
    round_stride: int = 3
    stride: int = 1
    val_scenes: int = 36
    workers: int | None = None


@dataclass(frozen=True)
class Args(VisionArgs):
    """Arguments of the training of the grasp network of `vision`.

    Attributes:
        out: Folder of the run.
        rounds: Number of DAgger rounds, evenly spread over the training.
        round_views: Number of views per scene in a DAgger round.
        use_hand_points: Whether points of the person's hand are an input.
        use_groups: Whether predictions use groups of neighboring points, as in PointNet++.
        auxiliary: Weight of the auxiliary losses of the object's center and displacement.
        extra_datasets: Other data sets, whose training scenes (of their first setup) are used too; `data_dir` is not
            theirs.
        shared_views: Folder of the first round's views, shared by several runs; default: in `out`.
        views_seed: Seed of the first round's views; default: `seed`. Runs that share views need the same one.
        resume: Whether to continue the run in the folder `out`.
    """

    out: str = "runs/vision"
    rounds: int = 2
    round_views: int = 60
    use_hand_points: bool = True
    use_groups: bool = True
    auxiliary: float = 1.0
    extra_datasets: tuple[str, ...] = ()
    shared_views: str | None = None
    views_seed: int | None = None
    resume: bool = False


class Training:
    """Training run of the grasp network of `vision`.

    Args:
        args: Arguments of the training.
    """

    def __init__(self, args: Args) -> None:
        args = args.resolve_setup()
        self._args, self._workers = args, args.workers or os.cpu_count() or 1
        self._data = args.open_dataset(args.robot)
        scenes = self._data.list_scenes(args.setup, "train")[:: args.stride]
        self._scenes, self._held_out = {args.dataset: select_training_scenes(scenes)}, select_held_out_scenes(scenes)
        for name in args.extra_datasets:
            extra = open_dataset(name, robot=args.robot)
            self._scenes[name] = extra.list_scenes(extra.resolve_setup(None), "train")[:: args.stride]
        self._val_scenes = select_scenes_evenly(self._data.list_scenes(args.setup, "val"), args.val_scenes)
        self._folder = open_run_folder(Path(args.out), args, args.resume, self._data.name, ("updates",))
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.manual_seed(args.seed)
        config = GraspTrainingConfig(center_loss_weight=2.0 * args.auxiliary, motion_loss_weight=args.auxiliary)
        group_sizes = GraspNetworkConfig.group_sizes if args.use_groups else ()
        network = GraspNetwork(GraspNetworkConfig(uses_hand_points=args.use_hand_points, group_sizes=group_sizes))
        self._trainer = GraspTrainer(network, config, args.updates, args.seed, self._device)
        self._best = -1.0
        if args.resume and (self._folder / CHECKPOINT).exists():
            read_checkpoint(self._folder / CHECKPOINT, self._restore)
        self._writer = SummaryWriter(str(self._folder / "logs"), purge_step=self._trainer.done)

    def run(self) -> Path:
        """Run all rounds of training; return the path of the best network's weights."""
        count = self._args.rounds + 1
        ends = np.linspace(0, self._args.updates, count + 1).round().astype(int)[1:].tolist()
        others = self._load_views(self._args.dataset, self._held_out, 0)
        held_out = ViewBatches(GraspViews._make(a[:: -(-len(a) // N_HELD_OUT)] for a in others), self._device)
        views: list[GraspViews] = []
        for number, end in enumerate(ends):
            views += [self._load_views(*chosen, number) for chosen in self._select_scenes(number)]
            if self._trainer.done >= end:
                continue
            joined = GraspViews(*(np.concatenate(arrays) for arrays in zip(*views, strict=True)))
            self._train(ViewBatches(joined, self._device), held_out, end)
            self._evaluate()
            self._save()
        return self._folder / WEIGHTS

    def _select_scenes(self, number: int) -> list[tuple[str, Sequence[int]]]:
        """Return the training scenes of a round by the names of the data sets."""
        stride = self._args.round_stride
        return [
            (dataset, scenes if number == 0 else scenes[number % stride :: stride] or scenes)
            for dataset, scenes in self._scenes.items()
        ]

    def _load_views(self, dataset: str, scenes: Sequence[int], number: int) -> GraspViews:
        """Return the views of scenes of a data set in a round; generate missing ones."""
        args, name = self._args, f"round_{number}"
        shared = args.shared_views if number == 0 else None
        folder = self._folder / "views" / name if shared is None else Path(shared)
        data_dir = args.data_dir
        if dataset != args.dataset:
            folder, data_dir = folder / re.sub(r"\W+", "-", dataset), None
        seed = args.seed if args.views_seed is None or number else args.views_seed
        config = ViewDatasetConfig(dataset, data_dir, args.robot, args.views, seed)
        if number:
            weights = self._folder / f"{name}.npz"
            config = replace(config, count=args.round_views, weights=str(weights))
            if not weights.exists():
                write_network_weights(weights, self._trainer.network, {})
        generate_views(config, scenes, folder, self._workers)
        return read_views(scenes, folder)

    def _train(self, views: ViewBatches, held_out: ViewBatches, end: int) -> None:
        trainer = self._trainer
        columns = (TextColumn("training"), BarColumn(), TextColumn("{task.completed}/{task.total} {task.fields[note]}"))
        with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as bar:
            task = bar.add_task("", total=end, completed=trainer.done, note="")
            while trainer.done < end:
                losses = trainer.update(views)
                bar.update(task, advance=1)
                if trainer.done % LOSS_INTERVAL and trainer.done < end:
                    continue
                for name, value in losses._asdict().items():
                    self._writer.add_scalar(f"loss/{name}", float(value), trainer.done)
                if trainer.done % METRICS_INTERVAL and trainer.done < end:
                    continue
                metrics = compute_grasp_metrics(trainer.network, held_out, trainer.config)
                for name, value in vars(metrics).items():
                    self._writer.add_scalar(f"held out/{name}", value, trainer.done)
                shares = f"within 1 cm {metrics.within_1cm:.0%}, 2 cm {metrics.within_2cm:.0%}"
                bar.update(task, note=f"held out: {shares}, {metrics.grasp_loss:.4f} m")
                self._save()

    def _evaluate(self) -> None:
        """Evaluate on the validation split, and keep the network if it is the best so far."""
        args = self._args
        latest = self._folder / "latest.npz"
        card = {
            "made by": describe_origin("train_vision", args),
            "steps": self._trainer.done,
            "dataset": ", ".join([self._data.name, *args.extra_datasets]),
        }
        write_network_weights(latest, self._trainer.network, card)
        report = benchmark(
            args.setup,
            "val",
            f"vision:weights={latest}",
            scenes=self._val_scenes,
            dataset=args.dataset,
            data_dir=args.data_dir,
            robot=args.robot,
            physics="fast",
            workers=self._workers,
            progress=False,
        )
        print(summarize_evaluation(report, f"{self._trainer.done} gradient updates"), flush=True)
        self._writer.add_scalar("val/success", report.success_rate, self._trainer.done)
        if report.success_rate >= self._best:
            self._best = report.success_rate
            latest.replace(self._folder / WEIGHTS)

    def _save(self) -> None:
        write_checkpoint(self._folder / CHECKPOINT, {**self._trainer.get_state(), "best": self._best})

    def _restore(self, state: dict[str, Any]) -> None:
        self._trainer.restore(state)
        self._best = float(state["best"])


def main(args: Args) -> Path:
    return Training(args).run()


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
