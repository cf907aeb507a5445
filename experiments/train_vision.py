"""Train the grasp network of the receiver `vision`. Needs the extras `train`, `plot`, `planning` and `vision`.

    python experiments/train_vision.py --data-dir DIR --out runs/vision

Takes views of a training split's moments from wherever the wrist camera may come by, tries the objects' grasps out if
that was not done yet, and learns to tell which grasps are good there. In later rounds the views that the receiver comes
by with what was learned are added (DAgger). After every round the receiver plays the validation split in fast physics;
the best network is kept. The folder gets `vision.npz` (`--receiver vision:weights=runs/vision/vision.npz`),
`learning_curve.csv` and `.png`, TensorBoard logs, the views, and a checkpoint: `--resume` goes on where a run was
stopped.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from torch.utils.tensorboard import SummaryWriter

from handover_marl import benchmark
from handover_marl.datasets import open_dataset
from handover_marl.imitation.vision.grasp_training import Batches, GraspTrainer, GraspTrainingConfig, scores
from handover_marl.imitation.vision.grasp_view_files import ViewSource, read_views, take_views
from handover_marl.imitation.vision.grasp_views import GraspViews
from handover_marl.networks.grasp_network import GraspNetwork, GraspNetworkConfig
from handover_marl.networks.own_weights import write_own_weights
from handover_marl.training.checkpoint import read_checkpoint, write_checkpoint
from handover_marl.training.learning_curve import CurvePoint
from handover_marl.training.run_folder import RunFolder, held_out_scenes, origin, spread_scenes, training_scenes

WEIGHTS = "vision.npz"
# Losses are noted every so many steps, and what is held out is looked at, at most so many views of it.
LOOK_EVERY, SCORE_EVERY, SCORED = 250, 1000, 1500


@dataclass(frozen=True)
class Args:
    """What to train on, and how long.

    Attributes:
        out: Folder of the run.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        robot: panda or panda_camera.
        seed: Of everything.
        steps: Batches in all.
        rounds: Rounds of views that the receiver comes by, evenly over the training.
        views: Views of a scene at first.
        round_views: Views of a scene in each later round, for which
        round_stride: every n-th scene is played, others in each round.
        stride: Of the training scenes every n-th, for trials.
        val_scenes: Scenes of the validation split to evaluate on, evenly chosen.
        hand: Whether points of the person's hand are seen.
        groups: Whether grasps are told from groups of near points, too, as in PointNet++; else as in PointNet.
        auxiliary: Weight of the losses of the object's middle and coming motion.
        shared_views: Folder where the first round's views are, or go, for several runs; default: in `out`.
        workers: Processes that take views and play; default: one a core.
        resume: Go on with the run in the folder.
    """

    out: str = "runs/vision"
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    robot: str = "panda_camera"
    seed: int = 0
    steps: int = 12_000
    rounds: int = 2
    views: int = 80
    round_views: int = 60
    round_stride: int = 3
    stride: int = 1
    val_scenes: int = 36
    hand: bool = True
    groups: bool = True
    auxiliary: float = 1.0
    shared_views: str | None = None
    workers: int | None = None
    resume: bool = False


class Training:
    """One run.

    Args:
        args: What to train on, and how long.
    """

    def __init__(self, args: Args) -> None:
        self._args, self._workers = args, args.workers or os.cpu_count() or 1
        self._data = open_dataset(args.dataset, args.data_dir, args.robot)
        scenes = self._data.split(args.setup, "train")[:: args.stride]
        self._scenes, self._held_out = training_scenes(scenes), held_out_scenes(scenes)
        self._folder = RunFolder(Path(args.out), args, args.resume, self._data.name)
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.manual_seed(args.seed)
        config = GraspTrainingConfig(middle=2.0 * args.auxiliary, motion=args.auxiliary)
        sizes = GraspNetworkConfig.groups if args.groups else ()
        network = GraspNetwork(GraspNetworkConfig(hand=args.hand, groups=sizes))
        self._trainer = GraspTrainer(network, config, args.steps, args.seed, self._device)
        self._seconds = 0.0
        if args.resume and self._folder.checkpoint.exists():
            read_checkpoint(self._folder.checkpoint, self._restore)
        self._folder.forget_after(self._trainer.done)
        self._logs = SummaryWriter(str(self._folder.path / "logs"), purge_step=self._trainer.done)

    def run(self) -> Path:
        """All rounds; the best network's file."""
        count = self._args.rounds + 1
        ends = np.linspace(0, self._args.steps, count + 1).round().astype(int)[1:].tolist()
        others = self._views(self._held_out, 0)
        held_out = Batches(GraspViews(*(a[:: -(-len(a) // SCORED)] for a in others)), self._device)
        views: list[GraspViews] = []
        for number, end in enumerate(ends):
            views.append(self._views(self._scenes if number == 0 else self._round_scenes(number), number))
            if self._trainer.done >= end:
                continue
            joined = GraspViews(*(np.concatenate(arrays) for arrays in zip(*views, strict=True)))
            self._learn(Batches(joined, self._device), held_out, end, number)
            self._evaluate()
            self._keep()
        return self._folder.path / WEIGHTS

    def _round_scenes(self, number: int) -> Sequence[int]:
        stride = self._args.round_stride
        return self._scenes[number % stride :: stride] or self._scenes

    def _views(self, scenes: Sequence[int], number: int) -> GraspViews:
        """Those of a round."""
        args, kind = self._args, f"round_{number}"
        shared = args.shared_views if number == 0 else None
        folder = self._folder.path / "views" / kind if shared is None else Path(shared)
        source = ViewSource(args.dataset, args.data_dir, args.robot, args.views, args.seed)
        if number:
            latest = str(self._folder.path / f"{kind}.npz")
            source = ViewSource(args.dataset, args.data_dir, args.robot, args.round_views, args.seed, weights=latest)
            if not Path(latest).exists():
                write_own_weights(Path(latest), self._trainer.network, {})
        take_views(source, scenes, folder, self._workers)
        return read_views(scenes, folder)

    def _learn(self, views: Batches, held_out: Batches, end: int, number: int) -> None:
        trainer, begun = self._trainer, time.perf_counter()
        columns = (TextColumn("learning"), BarColumn(), TextColumn("{task.completed}/{task.total} {task.fields[told]}"))
        with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as bar:
            task = bar.add_task("", total=end, completed=trainer.done, told="")
            while trainer.done < end:
                found = trainer.step(views)
                bar.update(task, advance=1)
                if trainer.done % LOOK_EVERY and trainer.done < end:
                    continue
                for name, value in found._asdict().items():
                    self._logs.add_scalar(f"loss/{name}", float(value), trainer.done)
                if trainer.done % SCORE_EVERY and trainer.done < end:
                    continue
                seen = scores(trainer.network, held_out, trainer.config)
                for name, value in vars(seen).items():
                    self._logs.add_scalar(f"held out/{name}", value, trainer.done)
                told = f"held out: best within 1 cm {seen.near:.0%}, 2 cm {seen.far:.0%}, loss {seen.grasp:.4f} m"
                bar.update(task, told=told)
                self._seconds, begun = self._seconds + time.perf_counter() - begun, time.perf_counter()
                self._keep()

    def _evaluate(self) -> None:
        """Play the validation split, and keep the network if it is the best so far."""
        args, begun = self._args, time.perf_counter()
        latest = self._folder.path / "latest.npz"
        card = {"made by": origin("train_vision", args), "steps": self._trainer.done, "dataset": self._data.name}
        write_own_weights(latest, self._trainer.network, card)
        report = benchmark(
            args.setup,
            "val",
            f"vision:weights={latest}",
            scenes=spread_scenes(self._data.split(args.setup, "val"), args.val_scenes),
            dataset=args.dataset,
            data_dir=args.data_dir,
            robot=args.robot,
            physics="fast",
            workers=self._workers,
            progress=False,
        )
        self._seconds += time.perf_counter() - begun
        point = CurvePoint.of(report, self._trainer.done, self._seconds, "replay")
        if not any(other.success > point.success for other in self._folder.points):
            latest.replace(self._folder.path / WEIGHTS)
        self._folder.add(point)
        self._logs.add_scalar("val/success", point.success, point.steps)

    def _keep(self) -> None:
        write_checkpoint(self._folder.checkpoint, {**self._trainer.state(), "seconds": self._seconds})

    def _restore(self, state: dict[str, object]) -> None:
        self._trainer.restore(state)
        self._seconds = float(state["seconds"])  # type: ignore[arg-type]


def main(args: Args) -> Path:
    return Training(args).run()


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
