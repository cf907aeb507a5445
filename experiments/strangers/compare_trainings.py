"""Compare two ways to train a receiver, with the givers of a population and many episodes at once.

    python experiments/strangers/compare_trainings.py --data-dir DIR --first a.npz b.npz c.npz --second d.npz e.npz

The files of `--first` must have the same features, action scheme and control period, and so must those of `--second`.
MuJoCo simulates the episodes of the files of one option with a giver together, which takes a fraction of the time of
`handover-marl strangers`. Scores, intervals and differences are computed as there: every file has the same scenes and
the same seeds of the givers.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.envs.config import EnvConfig
from handover_marl.envs.vector.batch import Envs
from handover_marl.envs.vector.env_factory import EnvFactory
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError
from handover_marl.evaluation.strangers.report import format_estimate
from handover_marl.evaluation.strangers.scores import compute_mean, estimate, estimate_difference
from handover_marl.execution.files import write_atomically
from handover_marl.learning.policy_files import read_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.policies.populations import DEFAULT_POPULATION, load_population
from handover_marl.simulation.engines import MUJOCO, BatchBackend

Array = npt.NDArray[np.float64]
StatusArray = npt.NDArray[np.int_]
_OUTCOMES = {
    "success": EpisodeStatus.SUCCESS,
    "contact": EpisodeStatus.HUMAN_CONTACT,
    "drop": EpisodeStatus.OBJECT_DROP,
    "timeout": EpisodeStatus.TIMEOUT,
}


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the comparison of two ways to train a receiver.

    Attributes:
        first: Policy files of the first way, one for each seed.
        second: Policy files of the second way.
        population: Name or file of the population.
        partners: Families of the population: train, test or all.
        split: Split of the scenes.
        n_scenes: Number of scenes, evenly spaced over the split.
        out: File for the scores of every episode (JSON); default: none.
    """

    first: tuple[Path, ...] = ()
    second: tuple[Path, ...] = ()
    population: str = DEFAULT_POPULATION
    partners: str = "train"
    split: str = "val"
    n_scenes: int = 36
    out: Path | None = None


def load_policies(files: tuple[Path, ...]) -> tuple[PolicySpec, list[DenseNetwork]]:
    """Read policy files, and return their common specification and their networks.

    Raises:
        OptionError: There is no file, or files have different features, action schemes or control periods.
    """
    if not files:
        raise OptionError("first and second must each have at least one policy file, got none")
    found = [read_policy(file, "receiver", False, None) for file in files]
    specs = {(one.spec.features, one.spec.actions, one.spec.control_period) for one in found}
    if len(specs) != 1:
        raise OptionError(f"policy files must have the same features, actions and control period, got {sorted(specs)}")
    return found[0].spec, [one.function for one in found]


def play(envs: Envs, functions: list[DenseNetwork], scenes: list[int]) -> tuple[StatusArray, Array]:
    """Return status bits and physics steps, each (policies, scenes), of an episode of each policy in each scene.

    Args:
        envs: Environments, one for each policy and scene.
        functions: Networks of the policies.
        scenes: Numbers of the scenes.
    """
    count = len(scenes)
    rows = np.arange(len(functions) * count)
    status, steps = np.zeros(len(rows), dtype=np.int_), np.zeros(len(rows))
    # All policies have the same seeds.
    results = [envs.reset(np.array([row]), [row % count], {"scene_id": scenes[row % count]}) for row in rows.tolist()]
    features = np.concatenate([result.observations["receiver"] for result in results])
    while len(rows):
        outputs = [functions[row // count](own[None])[0] for row, own in zip(rows.tolist(), features, strict=True)]
        result = envs.step(rows, {"receiver": np.stack(outputs).astype(np.float32)})
        infos = result.infos["receiver"]
        status[rows], steps[rows] = infos["status"], infos["steps"]
        running = ~result.ended
        rows, features = rows[running], result.observations["receiver"][running]
    return status.reshape(-1, count), steps.reshape(-1, count)


def play_partner(
    config: EnvConfig, partner: str, spec: PolicySpec, functions: list[DenseNetwork], scenes: list[int]
) -> tuple[StatusArray, Array]:
    """Return status bits and physics steps, each (policies, scenes), of policies with a giver; see `play`."""
    factory = EnvFactory(
        config=replace(config, control_period=spec.control_period),
        agent="receiver",
        partner=partner,
        features=spec.features,
        schemes=spec.actions,
        wrappers=(),
        trust=False,
        prefetch_episodes=False,
        backend=BatchBackend(),
    )
    envs = factory.make(len(functions) * len(scenes))
    found = play(envs, functions, scenes)
    envs.close()
    return found


def evaluate(args: Args) -> tuple[Array, dict[str, Array]]:
    """Evaluate the files of both ways, print a table, and return the scores.

    Returns:
        AS of every episode, an array (policies, partners, scenes), and such an array of 0 and 1 for every outcome.
    """
    ways = [load_policies(files) for files in (args.first, args.second)]
    scenes = list(select_scenes_evenly(args.open_dataset().list_scenes(args.setup, args.split), args.n_scenes))
    population = load_population(args.population)
    config = EnvConfig(args.setup, args.split, args.data_dir, args.dataset, MUJOCO)
    found = []
    print("| giver | family | first: success / contact / drop / timeout % | second |\n|---|---|---|---|")
    for partner in population.select("giver", args.partners):
        policy = population.get_policy(partner)
        parts = [play_partner(config, policy, *way, scenes) for way in ways]
        found.append([np.concatenate(arrays) for arrays in zip(*parts, strict=True)])
        print_partner(partner.name, partner.family, found[-1][0], len(args.first))
    status, steps = (np.stack(parts, axis=1) for parts in zip(*found, strict=True))
    outcomes = {name: ((status & int(bit)) != 0).astype(np.float64) for name, bit in _OUTCOMES.items()}
    return outcomes["success"] * (1.0 - steps / OFFICIAL_CONFIG.protocol.horizon_steps), outcomes


def print_partner(name: str, family: str, status: StatusArray, n_first: int) -> None:
    """Print the outcomes of both ways with a partner."""
    cells = []
    for part in (status[:n_first], status[n_first:]):
        rates = [f"{100 * ((part & int(bit)) != 0).mean():.0f}" for bit in _OUTCOMES.values()]
        cells.append(" / ".join(rates))
    print(f"| `{name}` | {family} | {' | '.join(cells)} |", flush=True)


def print_comparison(args: Args, scores: Array, outcomes: dict[str, Array]) -> None:
    """Print the summary of both ways, and their differences, first minus second."""
    ways = slice(0, len(args.first)), slice(len(args.first), None)
    families = [partner.family for partner in load_population(args.population).select("giver", args.partners)]
    for name, way in zip(("first", "second"), ways, strict=True):
        rates = ", ".join(f"{key} {100 * values[way].mean():.1f} %" for key, values in outcomes.items())
        seeds = ", ".join(f"{100 * own.mean():.1f}" for own in scores[way])
        found = estimate(compute_mean, scores[way], families)
        print(f"{name}: {rates}, AS {format_estimate(found)} (by file {seeds})")
    first, second = (scores[way] for way in ways)
    first_success, second_success = (outcomes["success"][way] for way in ways)
    success = estimate_difference(compute_mean, first_success, second_success, families)
    print(f"success, first minus second: {format_estimate(success)} points")
    print(
        f"AS, first minus second: {format_estimate(estimate_difference(compute_mean, first, second, families))} points"
    )


def main(args: Args) -> None:
    args = args.resolve_setup()
    scores, outcomes = evaluate(args)
    print(f"{scores.shape[1]} partners, {scores.shape[2]} scenes of {args.setup} {args.split}, MuJoCo physics")
    print_comparison(args, scores, outcomes)
    if args.out is not None:
        content = {"AS": scores.tolist(), **{name: values.tolist() for name, values in outcomes.items()}}
        write_atomically(args.out, json.dumps(content) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args))
