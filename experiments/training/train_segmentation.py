"""Train the segmentation network of the receiver `vision` (option `masks`).

The script needs the extras `train` and `vision`.

    python experiments/training/train_segmentation.py --data-dir DIR --out runs/segmentation

The script renders randomized images of a training split and trains the network to segment object, person's hand and
other objects; then it trains the network's part that separates the points of object and hand. Every tenth scene is
held out, and the script prints the intersections over union there. The folder gets the images, `pixels.npz` after the
first training, and `segmentation.npz` (`--receiver vision:masks=runs/segmentation/segmentation.npz`). A network that
was trained on scenes with one object mistakes other objects for the target.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

from handover_marl.learning.imitation.run import ImitationLearner, generate_samples, join_samples
from handover_marl.learning.imitation.vision.segmentation import (
    LabelledBatches,
    PointBatches,
    PointSegmentationLearner,
    SegmentationBatches,
    SegmentationLearner,
    SegmentationRenderer,
    SegmentationViews,
    collect_clouds,
)
from handover_marl.learning.networks.point_segmentation_network import PointSegmentationNetwork
from handover_marl.learning.networks.segmentation_network import N_CLASSES, SegmentationNetwork
from handover_marl.learning.networks.weights import read_network_weights, write_network_weights
from handover_marl.learning.training.run_folder import describe_origin, open_run_folder
from handover_marl.learning.training.scene_arguments import (
    SetupArgs,
    run_script,
    select_held_out_scenes,
    select_training_scenes,
)


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training of the segmentation network of `vision`.

    Attributes:
        out: Folder of the run.
        robot: Robot model: panda or panda_camera.
        seed: Seed of all random numbers.
        views: Number of rendered images per scene.
        stride: Use every n-th scene of the training split.
        updates: Number of gradient updates.
        batch_size: Number of image sections per gradient update.
        point_updates: Number of gradient updates of the network's part for points.
        point_batch_size: Number of point clouds per gradient update of that part.
        workers: Number of worker processes that render; default: one per core.
        device: PyTorch device.
        resume: Whether to use images and `pixels.npz` of an earlier run in the folder `out`.
    """

    out: Path = Path("runs/segmentation")
    robot: str = "panda_camera"
    seed: int = 0
    views: int = 8
    stride: int = 1
    updates: int = 12_000
    batch_size: int = 16
    point_updates: int = 7_000
    point_batch_size: int = 10
    workers: int | None = None
    device: str = "cpu"
    resume: bool = False


def load_views(args: Args, scenes: Sequence[int]) -> list[SegmentationViews]:
    """Return the images of each scene; render those that are not yet in the folder of the run."""

    def make_renderer() -> Callable[[int], SegmentationViews]:
        return SegmentationRenderer(args.open_dataset(args.robot), args.views, args.seed).render_scene

    return generate_samples(SegmentationViews, args.out / "views", scenes, make_renderer, "rendering", args.workers)


def train(
    learner: ImitationLearner[Any, Any], samples: LabelledBatches, held_out: LabelledBatches, size: int, seed: int
) -> None:
    """Train the network on batches of `size` samples drawn with `seed`; print its metrics on `held_out`."""
    for number in track(range(learner.updates), description="updates"):
        learner.update(samples.sample(size, np.random.default_rng((seed, number))))
    shares = {name: round(float(share), 3) for name, share in learner.evaluate(held_out).items()}
    print(f"intersection over union in {len(held_out)} images or clouds of held-out scenes: {shares}")


def main(args: Args) -> Path:
    """Train both parts of the network; return the path of its weights."""
    args = args.resolve_setup()
    data = args.open_dataset(args.robot)
    mutable_args = ("workers", "device", "point_updates", "point_batch_size")
    folder = open_run_folder(args.out, args, args.resume, data.name, mutable_args)
    scenes = data.list_scenes(args.setup, "train")[:: args.stride]
    parts = [load_views(args, select(scenes)) for select in (select_training_scenes, select_held_out_scenes)]
    torch.set_num_threads(1)
    pixels, path = folder / "pixels.npz", folder / "segmentation.npz"
    origin, device = {"made by": describe_origin("train_segmentation", args, "workers")}, torch.device(args.device)
    if not pixels.exists():
        torch.manual_seed(args.seed)
        learner = SegmentationLearner(SegmentationNetwork(), args.updates, device)
        images, held_out = (SegmentationBatches(join_samples(part)) for part in parts)
        train(learner, images, held_out, args.batch_size, args.seed)
        write_network_weights(pixels, learner.averaged_network, origin)
    network, _ = read_network_weights(pixels, SegmentationNetwork)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    found = [[cloud for one in part if (cloud := collect_clouds(network, one, rng))] for part in parts]
    point_learner = PointSegmentationLearner(PointSegmentationNetwork(N_CLASSES), args.point_updates, device)
    clouds, held_out_clouds = (PointBatches(join_samples(part)) for part in found)
    train(point_learner, clouds, held_out_clouds, args.point_batch_size, args.seed)
    network.points = point_learner.averaged_network
    write_network_weights(path, network, origin)
    return path


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
