"""Train givers and receivers alternately, each for the other's latest policy (best response).

    python experiments/training/best_response.py --data-dir DIR --out runs/responses

Each round trains both agents anew for the other's latest policy, with `train_giver_sb3.py` and
`train_receiver_sb3.py` in this folder, and evaluates all givers with all receivers on the
validation split (`crossplay.md`, `.csv` and `.png`). The script needs the extras `train` and `plot`. The same
command continues an interrupted run.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import train_giver_sb3
import train_receiver_sb3
import tyro

from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.evaluation.crossplay import crossplay
from handover_marl.learning.training.scene_arguments import SetupArgs


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the alternating training of givers and receivers.

    Attributes:
        out: Folder with one folder per training run.
        rounds: Number of rounds.
        first_receiver: Name of the receiver for which the first giver is trained.
        physics: Simulation: fast or exact.
        seed: Random seed of the first round; each round adds 1.
        val_scenes: Number of validation scenes, evenly chosen.
        giver: Further arguments of `train_giver_sb3.py`.
        receiver: Further arguments of `train_receiver_sb3.py`.
    """

    out: str = "runs/responses"
    rounds: int = 2
    first_receiver: str = "yang2021"
    physics: str = "fast"
    seed: int = 0
    val_scenes: int = 36
    giver: train_giver_sb3.Args = field(default_factory=train_giver_sb3.Args)
    receiver: train_receiver_sb3.Args = field(default_factory=train_receiver_sb3.Args)


def main(args: Args) -> None:
    args = args.resolve_setup()
    out = Path(args.out)
    val = select_scenes_evenly(args.open_dataset().list_scenes(args.setup, "val"), args.val_scenes)
    givers, receivers = ["replay"], [args.first_receiver]
    options = {name: getattr(args, name) for name in ("setup", "data_dir", "dataset", "physics")}
    for number in range(1, args.rounds + 1):
        common = options | {"seed": args.seed + number - 1}
        givers.append(
            train_response(train_giver_sb3, args.giver, out / f"giver-{number}", common | {"receiver": receivers[-1]})
        )
        receivers.append(
            train_response(
                train_receiver_sb3, args.receiver, out / f"receiver-{number}", common | {"giver": givers[-1]}
            )
        )
        print(crossplay(givers, receivers, split="val", scenes=val, out=out / "crossplay", **options))


def train_response(script: ModuleType, args: Any, folder: Path, changes: dict[str, Any]) -> str:
    """Train one agent for the other agent's latest policy, unless this training run is finished already.

    Args:
        script: Training script of the agent, as a module.
        args: Arguments of the script.
        folder: Folder of the training run.
        changes: Arguments with other values than in `args`, for example the other agent's policy.

    Returns:
        Name of the trained policy, `learned:FILE`.
    """
    done = folder / "done"
    if not done.exists():
        # An interrupted run is resumed even before its first checkpoint.
        script.main(replace(args, out=str(folder), resume=folder.exists(), **changes))
        done.touch()
    return f"learned:{folder / 'policy.npz'}"


if __name__ == "__main__":
    main(tyro.cli(Args))
