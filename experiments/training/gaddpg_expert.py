"""Evaluate the expert that `train_gaddpg.py` imitates, in the protocol of the receiver `gaddpg`.

    python experiments/training/gaddpg_expert.py --data-dir DIR --split val --wait 3

The result is an upper bound for imitation. The expert knows the true pose of the object, but not
the person's hand. Needs the extras `planning` and `vision`.
"""

from dataclasses import dataclass, replace

import tyro

from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.learning.imitation.gaddpg.expert_receiver import ExpertReceiver


@dataclass(frozen=True)
class Args:
    """Arguments of the evaluation of the expert of `gaddpg`.

    Attributes:
        setup: Official setup, s0 to s3.
        split: Split: train or val.
        scenes: Scene numbers; default: all of the split.
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        dataset: Dataset: dexycb, synthetic, or auto.
        physics: Simulation: fast or exact.
        wait: Time (s) that the robot waits at its start pose.
        workers: Number of worker processes; default: one per core.
    """

    setup: str = "s0"
    split: str = "val"
    scenes: tuple[int, ...] | None = None
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    wait: float = 3.0
    workers: int | None = None


def main(args: Args) -> None:
    config = EvaluationConfig(
        args.setup, args.split, args.scenes, args.dataset, args.data_dir, args.physics, robot=PANDA_CAMERA
    )
    report = evaluate_pair(
        replace(config, receiver=(ExpertReceiver, {"wait": args.wait})), execution=ExecutionConfig(args.workers)
    )
    for episode in report.episodes:
        print(episode.scene_id, episode.status.label)
    print(report)


if __name__ == "__main__":
    main(tyro.cli(Args))
