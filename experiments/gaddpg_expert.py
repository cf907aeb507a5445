"""What imitation can reach: the expert that `train_gaddpg.py` learns from, in the protocol of `gaddpg`.

    python experiments/gaddpg_expert.py --data-dir DIR --split val --wait 3

It knows the object's true pose and nothing of the person's hand. Needs `planning`, `vision`.
"""

from dataclasses import dataclass, replace

import tyro

from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.imitation.gaddpg.expert_receiver import ExpertReceiver
from handover_marl.models.panda import PANDA_CAMERA
from handover_marl.run import Execution, Run


@dataclass(frozen=True)
class Args:
    """What to play.

    Attributes:
        setup: Official setup, s0 to s3.
        split: train or val.
        scenes: Only these.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: fast or exact.
        wait: How long it stays at the start pose (s).
        workers: Processes.
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
    run = Run(args.setup, args.split, args.scenes, args.dataset, args.data_dir, args.physics, robot=PANDA_CAMERA)
    chosen = (ExpertReceiver, {"wait": args.wait})
    report = evaluate_run(replace(run, receiver=chosen), Execution(args.workers))
    for episode in report.episodes:
        print(episode.scene_id, episode.status.label)
    print(report)


if __name__ == "__main__":
    main(tyro.cli(Args))
