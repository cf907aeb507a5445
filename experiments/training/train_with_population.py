"""Train receivers or givers with partners of a population, with several seeds.

    python experiments/training/train_with_population.py --data-dir DIR --ego receiver --method population

| method | partners of the trained policy |
|---|---|
| `best_response` | one partner, `--partner` |
| `population` | another member of the population's train families in each episode |
| `fictitious_co_play` | networks of several pairs, at half and at the end of their training |
| `history` | as `population`; the receiver observes its last four decisions, and can identify its partner by them |

Fictitious co-play follows Strouse et al. (NeurIPS 2021), but the two policies of a pair are trained one after the
other: the receiver with `replay`, and the giver with this receiver. The policies are `OUT/EGO_METHOD_SEED.npz`, the
pairs are in `OUT/pairs`. The script needs the extras `train`, `plot` and `mujoco`. The same command continues an
interrupted run after the last written policy.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import train_giver_sb3
import train_receiver_ppo
import tyro

from handover_marl.errors import OptionError
from handover_marl.execution.files import write_atomically
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.policies.populations import DEFAULT_POPULATION, TRAIN, Partner, format_population

_PAIRS_FILE = "pairs.json"


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training with a population.

    Attributes:
        ego: Agent that learns.
        method: Choice of the partners.
        seeds: Seeds of the trainings.
        out: Folder of the policies.
        partner: Partner of the method best_response; default: replay for receivers, yang2021 for givers.
        population: Name of a shipped population, or path of a file.
        pairs: Number of pairs of the method fictitious_co_play.
        receiver: Further arguments of `train_receiver_ppo.py`.
        giver: Further arguments of `train_giver_sb3.py`.
    """

    ego: Literal["receiver", "giver"] = "receiver"
    method: Literal["best_response", "population", "fictitious_co_play", "history"] = "population"
    seeds: tuple[int, ...] = (0, 1, 2)
    out: Path = Path("runs/population")
    partner: str = ""
    population: str = DEFAULT_POPULATION
    pairs: int = 3
    receiver: train_receiver_ppo.Args = field(default_factory=lambda: train_receiver_ppo.Args(val_scenes=0))
    giver: train_giver_sb3.Args = field(
        default_factory=lambda: train_giver_sb3.Args(
            physics="mujoco", batch_size=64, epochs=20, eval_interval=8192, eval_start=False
        )
    )

    def __post_init__(self) -> None:
        if self.ego == "giver" and self.method == "history":
            raise OptionError("method must not be history for a giver, which decides once in an episode; got history")


def train_receiver(args: Args, giver: str, path: Path, seed: int, features: str, share: float = 1.0) -> Path:
    """Train a receiver with a giver, unless its policy file exists.

    Args:
        args: Arguments of the script.
        giver: Giver with options.
        path: Policy file.
        seed: Seed of the training.
        features: Features of the receiver.
        share: Share of the decisions in `args.receiver` after which the training stops.
    """
    if not path.exists():
        decisions = round(share * args.receiver.decisions)
        changes = {"giver": giver, "out": path, "seed": seed, "features": features, "decisions": decisions}
        train_receiver_ppo.main(replace(args.receiver, **_get_scenes(args), **changes))
    return path


def train_giver(args: Args, receiver: str, path: Path, folder: Path, seed: int, share: float = 1.0) -> Path:
    """Train a giver with a receiver, unless its policy file exists; continue the training in the folder.

    Args:
        args: Arguments of the script.
        receiver: Receiver with options.
        path: Policy file.
        folder: Folder of the training.
        seed: Seed of the training.
        share: Share of the steps in `args.giver` after which the training stops.
    """
    if not path.exists():
        steps = round(share * args.giver.steps)
        changes = {"receiver": receiver, "out": str(folder), "seed": seed, "steps": steps, "resume": folder.exists()}
        policy = train_giver_sb3.main(replace(args.giver, **_get_scenes(args), **changes))
        write_atomically(path, policy.read_bytes())
    return path


def _get_scenes(args: Args) -> dict[str, str | None]:
    return {"data_dir": args.data_dir, "dataset": args.dataset, "setup": args.setup}


def train_pairs(args: Args) -> Path:
    """Train the pairs, and return the file of the population of their policies.

    The pairs have other seeds than the trainings of the script, 1000 and following.
    """
    folder = args.out / "pairs"
    names: dict[str, list[str]] = {"giver": [], "receiver": []}
    for seed in range(1000, 1000 + args.pairs):
        for label, share in (("mid", 0.5), ("final", 1.0)):
            receiver = folder / f"receiver_{label}_{seed}.npz"
            train_receiver(args, "replay", receiver, seed, args.receiver.features, share)
            names["receiver"].append(receiver.name)
        for label, share in (("mid", 0.5), ("final", 1.0)):
            giver = folder / f"giver_{label}_{seed}.npz"
            train_giver(args, f"learned:{receiver}", giver, folder / f"giver_{seed}", seed, share)
            names["giver"].append(giver.name)
    givers, receivers = (
        [Partner(Path(name).stem, "pairs", TRAIN, f"learned:{{folder}}/{name}", "trained in a pair") for name in own]
        for own in names.values()
    )
    description = f"Networks of {args.pairs} pairs, at half and at the end of their training."
    file = folder / _PAIRS_FILE
    write_atomically(file, format_population("pairs", "1", description, givers, receivers))
    return file


def choose_partner(args: Args) -> str:
    """Return the partner of the trained policy, after the training of the pairs if the method needs them."""
    if args.method == "best_response":
        return args.partner or {"receiver": "replay", "giver": "yang2021"}[args.ego]
    population = train_pairs(args) if args.method == "fictitious_co_play" else args.population
    return f"population:population={population}"


def main(args: Args) -> list[Path]:
    """Train a policy with every seed, and return the policy files."""
    args = args.resolve_setup()
    partner = choose_partner(args)
    paths = []
    for seed in args.seeds:
        path = args.out / f"{args.ego}_{args.method}_{seed}.npz"
        if args.ego == "giver":
            paths.append(train_giver(args, partner, path, path.with_suffix(""), seed))
        else:
            features = "close_stack" if args.method == "history" else args.receiver.features
            paths.append(train_receiver(args, partner, path, seed, features))
    return paths


if __name__ == "__main__":
    for policy_file in main(tyro.cli(Args, description=__doc__)):
        print(policy_file)
