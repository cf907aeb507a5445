"""Train receivers or givers with the partners of a population, one policy for each seed.

    python experiments/training/train_with_population.py --data-dir DIR --agent receiver --method population

| method | partners of the trained policy |
|---|---|
| `best_response` | one partner, `--partner` |
| `population` | a randomly drawn member of the population's train families in each episode |
| `fictitious_co_play` | networks of several pairs, after half of their training and after all of it |
| `history` | as `population`; the receiver observes the features of its last four decisions (`close_stack`) |

`fictitious_co_play` simplifies the method of Strouse et al. (NeurIPS 2021): of each pair, first the receiver is trained
with `replay`, then the giver with this receiver, and there are no untrained partners. The policies are
`OUT/AGENT_METHOD/SEED.npz`, the pairs are in `OUT/pairs`. The script needs the extra `train`. The same command
continues an interrupted run after the last written policy.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import train_ppo

from handover_marl.errors import OptionError
from handover_marl.execution.files import write_atomically
from handover_marl.learning.training.run_folder import open_run_folder
from handover_marl.learning.training.scene_arguments import SetupArgs, run_script
from handover_marl.policies.populations import DEFAULT_POPULATION, TRAIN, Partner, format_population, load_population
from handover_marl.policies.reference import parse_policy

_Agent = Literal["receiver", "giver"]
_FIRST_PAIR_SEED = 1000
_MAX_MINUTES = 600.0


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training with a population.

    Attributes:
        agent: Agent that learns.
        method: Method that determines the partners.
        seeds: Seeds of the trainings; the pairs have the seeds from 1000 on.
        out: Folder of the policies.
        partner: Partner of the method best_response; default: replay for receivers, yang2021 for givers.
        population: Name of a shipped population, or path of a population file.
        pairs: Number of pairs of the method fictitious_co_play.
        receiver: Further arguments of `train_ppo.py` for receivers; this script sets agent, partner, out, seed and
            the data.
        giver: Further arguments of `train_ppo.py` for givers.
    """

    agent: _Agent = "receiver"
    method: Literal["best_response", "population", "fictitious_co_play", "history"] = "population"
    seeds: tuple[int, ...] = (0, 1, 2)
    out: Path = Path("runs/population")
    partner: str = ""
    population: str = DEFAULT_POPULATION
    pairs: int = 3
    receiver: train_ppo.Args = field(default_factory=lambda: train_ppo.Args(val_scenes=0, minutes=_MAX_MINUTES))
    giver: train_ppo.Args = field(
        default_factory=lambda: train_ppo.Args(
            decisions=8192,
            batch_size=512,
            control_period=0.1,
            initial_std=0.25,
            val_scenes=0,
            minutes=_MAX_MINUTES,
        )
    )

    def __post_init__(self) -> None:
        if self.agent == "giver" and self.method == "history":
            raise OptionError("method must be another one for a giver, got history; its features are for receivers")
        if self.partner and self.method != "best_response":
            raise OptionError(f"partner must be left out with method {self.method}, got {self.partner!r}")

    def open_folder(self, name: str, mutable_args: tuple[str, ...], **hashes: str) -> Path:
        """Make or check the folder `name` in `out` and return it; see `open_run_folder`."""
        path = self.out / name
        return open_run_folder(path, self, path.exists(), self.open_dataset().name, mutable_args, **hashes)


def train_policy(args: Args, agent: _Agent, partner: str, path: Path, seed: int, share: float = 1.0) -> Path:
    """Train an agent with a fixed partner and write its policy to `path`, unless this file exists; return `path`.

    The training has the share `share` (0 to 1) of the `decisions` in the agent's arguments.
    """
    if path.exists():
        return path
    own: train_ppo.Args = getattr(args, agent)
    features = "close_stack" if args.method == "history" and agent == "receiver" else own.features
    where: dict[str, Any] = {"data_dir": args.data_dir, "dataset": args.dataset, "setup": args.setup, "seed": seed}
    decisions = round(share * own.decisions)
    return train_ppo.main(
        replace(own, agent=agent, partner=partner, out=path, features=features, decisions=decisions, **where)
    )


def train_pairs(args: Args) -> Path:
    """Train the pairs, and return the path of the file of the population that their policies form."""
    folder = args.open_folder("pairs", ("agent", "method", "seeds", "partner", "population"))
    partners: dict[_Agent, list[Partner]] = {"giver": [], "receiver": []}
    for seed in range(_FIRST_PAIR_SEED, _FIRST_PAIR_SEED + args.pairs):
        trained = f"learned:{folder}/receiver_final_{seed}.npz"
        turns: tuple[tuple[_Agent, str], ...] = (("receiver", "replay"), ("giver", trained))
        for agent, partner in turns:
            mid, final = (folder / f"{agent}_{label}_{seed}.npz" for label in ("mid", "final"))
            for path, share in ((mid, 0.5), (final, 1.0)):
                train_policy(args, agent, partner, path, seed, share)
                policy = f"learned:{{folder}}/{path.name}"
                partners[agent].append(Partner(path.stem, "pairs", TRAIN, policy, "Network of a pair."))
    description = f"Networks of {args.pairs} pairs, after half of their training and after all of it."
    file = folder / "pairs.json"
    write_atomically(file, format_population("pairs", "1", description, partners["giver"], partners["receiver"]))
    return file


def main(args: Args) -> list[Path]:
    """Train a policy with every seed, and return the paths of the policy files."""
    args = args.resolve_setup()
    partner = args.partner or {"receiver": "replay", "giver": "yang2021"}[args.agent]
    parse_policy("giver" if args.agent == "receiver" else "receiver", partner)
    found = load_population(args.population)
    folder = args.open_folder(f"{args.agent}_{args.method}", ("seeds",), population_hash=found.content_hash)
    if args.method != "best_response":
        population = train_pairs(args) if args.method == "fictitious_co_play" else args.population
        partner = f"population:population={population}"
    return [train_policy(args, args.agent, partner, folder / f"{seed}.npz", seed) for seed in args.seeds]


if __name__ == "__main__":
    for policy_file in run_script(main, Args, __doc__):
        print(policy_file)
