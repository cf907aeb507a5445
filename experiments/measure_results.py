"""Evaluate receivers on official test splits, for the results page.

    python experiments/measure_results.py --data-dir DIR --receivers yang2021 reactive reactive:wait=3.0
    python experiments/make_results.py --add results/measured/*

Some scenes belong to the test splits of several setups. The outcome of an episode does not depend
on the setup, so that such a scene is simulated once, and its result is copied to the folders of the
other setups. An interrupted run continues.
"""

import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl.datasets.splits import SETUPS
from handover_marl.episode.spaces import STATE
from handover_marl.evaluation.benchmark import Evaluation
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.results.result_folder import get_result_path
from handover_marl.geometry.panda import PANDA, PANDA_CAMERA
from handover_marl.policies.reference import parse_policy


@dataclass(frozen=True)
class Args:
    """Options of the evaluation of receivers on test splits.

    Attributes:
        receivers: Names of the receivers, with options if there are any.
        setups: Official setups whose test splits are evaluated.
        split: Split of the setups; only test splits belong on the results page.
        dataset: Data set, dexycb or synthetic.
        data_dir: Data folder in HandoverSim's layout.
        physics: Physics engine; only results in exact physics belong on the results page.
        workers: Number of worker processes; default: one per core.
        out: Folder for the result folders.
    """

    receivers: tuple[str, ...] = ("yang2021",)
    setups: tuple[str, ...] = SETUPS
    split: str = "test"
    dataset: str = "dexycb"
    data_dir: str | None = None
    physics: str = "exact"
    workers: int | None = None
    out: Path = Path("results/measured")


def measure_receiver(receiver: str, args: Args) -> Iterable[Report]:
    """Evaluate a receiver on the split of each setup, and yield a report for each setup."""
    has_camera = parse_policy("receiver", receiver).policy_class.obs_mode != STATE
    paths: dict[int, Path] = {}  # result file of each scene that has been simulated
    for setup in args.setups:
        config = EvaluationConfig(
            setup=setup,
            split=args.split,
            dataset=args.dataset,
            data_dir=args.data_dir,
            physics=args.physics,
            receiver=receiver,
            robot=PANDA_CAMERA if has_camera else PANDA,
        )
        scenes = config.open_dataset().list_scenes(setup, args.split)
        name = re.sub(r"\W+", "-", f"{receiver}-{args.dataset}-{setup}")
        execution = ExecutionConfig(workers=args.workers, out=str(args.out / name))
        evaluation = Evaluation(config, execution)
        for index, scene in enumerate(scenes):
            path = get_result_path(args.out / name, index)
            if scene in paths and not path.exists():
                shutil.copyfile(paths[scene], path)
            paths.setdefault(scene, path)
        yield evaluation.run()


def main(args: Args) -> None:
    """Evaluate all receivers and print their reports."""
    for receiver in args.receivers:
        for report in measure_receiver(receiver, args):
            print(report)
    print(f"The results are in {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
