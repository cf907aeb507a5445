"""Alternate best responses: train a giver for the receiver, then a receiver for the giver, and so on.

    python experiments/best_response.py --data-dir DIR --out runs/responses

Each round trains both anew for the other's latest policy, with the scripts `train_giver_sb3.py` and
`train_receiver_sb3.py` beside this one, and plays all policies so far against each other on the validation split
(`crossplay.md`, `.csv` and `.png`). Needs the extras `train` and `plot`; the same command goes on where a run was
stopped.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import train_giver_sb3
import train_receiver_sb3
import tyro

from handover_marl.benchmarking.crossplay import crossplay
from handover_marl.datasets import open_dataset
from handover_marl.training.run_folder import spread_scenes


@dataclass(frozen=True)
class Args:
    """What to alternate, and how.

    Attributes:
        out: Folder; every training run gets one in it.
        rounds: How often both respond.
        first_receiver: Whom the first giver is trained for.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: fast or exact.
        seed: Of the first round; every round adds one.
        val_scenes: Scenes of the validation split to play, evenly chosen.
        giver: How givers are trained; its folder, partner, data and seed are set from here.
        receiver: How receivers are trained, likewise.
    """

    out: str = "runs/responses"
    rounds: int = 2
    first_receiver: str = "yang2021"
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    seed: int = 0
    val_scenes: int = 36
    giver: train_giver_sb3.Args = field(default_factory=train_giver_sb3.Args)
    receiver: train_receiver_sb3.Args = field(default_factory=train_receiver_sb3.Args)


def main(args: Args) -> None:
    out = Path(args.out)
    data = open_dataset(args.dataset, args.data_dir)
    val = spread_scenes(data.split(args.setup, "val"), args.val_scenes)
    givers, receivers = ["replay"], [args.first_receiver]
    for number in range(1, args.rounds + 1):
        common = {
            "setup": args.setup,
            "data_dir": args.data_dir,
            "dataset": args.dataset,
            "physics": args.physics,
            "seed": args.seed + number - 1,
        }
        givers.append(
            respond(train_giver_sb3, args.giver, out / f"giver-{number}", common | {"receiver": receivers[-1]})
        )
        receivers.append(
            respond(train_receiver_sb3, args.receiver, out / f"receiver-{number}", common | {"giver": givers[-1]})
        )
        played = crossplay(
            givers,
            receivers,
            args.setup,
            "val",
            scenes=val,
            data_dir=args.data_dir,
            dataset=args.dataset,
            physics=args.physics,
            out=out / "crossplay",
        )
        print(played)


def respond(script: ModuleType, args: Any, folder: Path, changes: dict[str, Any]) -> str:
    """Train for the other side's latest policy unless that is done; returns the new policy's name."""
    done = folder / "done"
    if not done.exists():
        # Also where it was stopped before its first checkpoint.
        script.main(replace(args, out=str(folder), resume=folder.exists(), **changes))
        done.touch()
    return f"learned:{folder / 'policy.npz'}"


if __name__ == "__main__":
    main(tyro.cli(Args))
