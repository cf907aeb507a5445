"""Train the grasp network of the receiver `vision`.

The script needs the extras `train`, `planning` and `vision`.

    python experiments/training/train_vision.py --data-dir DIR --out runs/vision

The script renders views of a training split from random poses of the wrist camera, validates the objects' grasps in
simulation if that was not done yet, and trains the network to predict good grasps. With `--extra-datasets
generated:n=1000,seed=7`, the training scenes of other data sets are used too. At the end the receiver is evaluated on
the validation split in fast physics. The folder gets `vision.npz` (`--receiver vision:weights=runs/vision/vision.npz`),
TensorBoard logs, the views, and a checkpoint, from which `--resume` continues.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from handover_marl.datasets import open_dataset
from handover_marl.learning.imitation.run import ImitationArgs, ImitationRun, generate_samples, join_samples
from handover_marl.learning.imitation.vision.training import GraspLearner, ViewBatches
from handover_marl.learning.imitation.vision.views import GraspViews, ViewRenderer
from handover_marl.learning.networks.grasp_network import GraspNetwork
from handover_marl.learning.training.scene_arguments import run_script, select_held_out_scenes, select_training_scenes

# Maximum number of held-out views for the metrics.
N_HELD_OUT = 1500


@dataclass(frozen=True)
class Args(ImitationArgs):
    """Arguments of the training of the grasp network of `vision`.

    Attributes:
        robot: Robot model: panda or panda_camera.
        views: Number of rendered camera views per scene.
        stride: Use every n-th scene of the training split.
        extra_datasets: Other data sets; the training scenes of their first setups are used, too. `data_dir` does not
            apply to them.
        views_seed: Seed of the views; default: `seed`.
    """

    out: str = "runs/vision"
    robot: str = "panda_camera"
    views: int = 80
    stride: int = 1
    extra_datasets: tuple[str, ...] = ()
    views_seed: int | None = None


def load_views(args: Args, run: ImitationRun, dataset: str, scenes: Sequence[int]) -> GraspViews:
    """Return the views of scenes of a data set; render those that are not yet in the folder of the run."""
    folder, data_dir = run.folder / "views", args.data_dir
    if dataset != args.dataset:
        folder, data_dir = folder / re.sub(r"\W+", "-", dataset), None
    seed = args.seed if args.views_seed is None else args.views_seed

    def make_renderer() -> Callable[[int], GraspViews]:
        return ViewRenderer(open_dataset(dataset, data_dir, args.robot), args.views, seed).render_scene

    return join_samples(generate_samples(GraspViews, folder, scenes, make_renderer, "rendering views", args.workers))


def main(args: Args) -> Path:
    """Train the network, and evaluate the receiver with it; return the path of the best weights."""
    args = args.resolve_setup()
    scenes = args.open_dataset(args.robot).list_scenes(args.setup, "train")[:: args.stride]
    training = {args.dataset: select_training_scenes(scenes)}
    for name in args.extra_datasets:
        extra = open_dataset(name, robot=args.robot)
        training[name] = extra.list_scenes(extra.resolve_setup(None), "train")[:: args.stride]
    torch.manual_seed(args.seed)
    learner = GraspLearner(GraspNetwork(), args.updates, args.torch_device)
    run = ImitationRun(args, "vision", args.robot, learner, ("updates",))
    others = load_views(args, run, args.dataset, select_held_out_scenes(scenes))
    held_out = GraspViews._make(part[:: -(-len(part) // N_HELD_OUT)] for part in others)

    def load_all(number: int) -> GraspViews:
        """Return the views of the training scenes of all data sets; `number` is 0, the only round."""
        return join_samples([load_views(args, run, name, ids) for name, ids in training.items()])

    return run.train(
        load_all, lambda views: ViewBatches(views, args.torch_device), ViewBatches(held_out, args.torch_device)
    )


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
