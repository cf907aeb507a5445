"""Train the segmentation network of the receiver `vision` (option `masks`).

The script needs the extras `train` and `vision`.

    python experiments/training/train_segmentation.py --data-dir DIR --out runs/segmentation

The script renders randomised images of a training split, trains the network to segment object, person's hand and other
objects, and prints its intersection over union on held-out scenes of the split, every tenth. The folder gets the images
and `segmentation.npz` (`--receiver vision:masks=runs/segmentation/segmentation.npz`). A network that was trained on
scenes with one object takes other objects for it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from rich.progress import track

from handover_marl.learning.imitation.samples import generate_samples, join_samples
from handover_marl.learning.imitation.vision.segmentation import (
    SegmentationBatches,
    SegmentationLearner,
    SegmentationRenderer,
    SegmentationViews,
)
from handover_marl.learning.networks.segmentation_network import SegmentationNetwork
from handover_marl.learning.networks.weights import write_network_weights
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
        batch_size: Number of sections of images per gradient update.
        workers: Number of worker processes that render; default: one per core.
        device: PyTorch device.
        resume: Whether to use the images that an earlier run has left in the folder `out`.
    """

    out: Path = Path("runs/segmentation")
    robot: str = "panda_camera"
    seed: int = 0
    views: int = 8
    stride: int = 1
    updates: int = 12_000
    batch_size: int = 16
    workers: int | None = None
    device: str = "cpu"
    resume: bool = False


def load_batches(args: Args, scenes: Sequence[int]) -> SegmentationBatches:
    """Return batches of the images of scenes; render images that are not in the folder of the run."""

    def make_renderer() -> Callable[[int], SegmentationViews]:
        return SegmentationRenderer(args.open_dataset(args.robot), args.views, args.seed).render_scene

    folder = args.out / "views"
    views = generate_samples(SegmentationViews, folder, scenes, make_renderer, "rendering", args.workers)
    return SegmentationBatches(join_samples(views))


def main(args: Args) -> Path:
    """Train; return the path of the weights."""
    args = args.resolve_setup()
    data = args.open_dataset(args.robot)
    folder = open_run_folder(args.out, args, args.resume, data.name, ("workers", "device", "updates", "batch_size"))
    scenes = data.list_scenes(args.setup, "train")[:: args.stride]
    batches = load_batches(args, select_training_scenes(scenes))
    held_out = load_batches(args, select_held_out_scenes(scenes))
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    learner = SegmentationLearner(SegmentationNetwork(), args.updates, torch.device(args.device))
    for number in track(range(args.updates), description="updates"):
        learner.update(batches.sample(args.batch_size, np.random.default_rng((args.seed, number))))
    shares = {name: round(float(share), 3) for name, share in learner.evaluate(held_out).items()}
    print(f"intersection over union in {len(held_out)} images of held-out scenes: {shares}")
    path = folder / "segmentation.npz"
    write_network_weights(path, learner.averaged, {"made by": describe_origin("train_segmentation", args)})
    return path


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
