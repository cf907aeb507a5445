"""Evaluate the expert that `train_gaddpg.py` imitates, in the protocol of the receiver `gaddpg`.

    python experiments/measure_gaddpg_expert.py --data-dir DIR --split val --wait 3

The result is an upper bound for imitation. The expert knows the true pose of the object, but not
the person's hand. The script needs the extras `planning` and `vision`.
"""

from dataclasses import dataclass

import tyro

from handover_marl.cli.options import SceneNumbers
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.learning.imitation.gaddpg.expert_receiver import ExpertReceiver
from handover_marl.learning.training.scene_arguments import EvaluationArgs


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Arguments of the evaluation of the expert of `gaddpg`.

    Attributes:
        split: Split: train or val.
        scenes: Scene numbers; default: all of the split.
        wait: Time (s) that the robot waits at its start pose.
    """

    split: str = "val"
    scenes: SceneNumbers = None
    wait: float = 3.0


def main(args: Args) -> None:
    expert = (ExpertReceiver, {"wait": args.wait})
    report = evaluate_pair(
        receiver=expert, split=args.split, scenes=args.scenes, robot=PANDA_CAMERA, **args.evaluation_options
    )
    for episode in report.episodes:
        print(episode.scene_id, episode.status.label)
    print(report)


if __name__ == "__main__":
    main(tyro.cli(Args))
