"""Measure controls of the strangers benchmark: noise floor, start positions and preview, for every giver.

    python experiments/strangers/measure_controls.py --data-dir DIR --out docs/results/data/strangers_controls.json

Every scene is simulated with every giver under several conditions: without changes; with a perturbation of all joint
targets of the robot, whose signs are drawn for the scene, once for each seed; from a random start position of the
robot; and, for givers that observe their recording's next half second, without this preview. The noise floor is the
share of perturbed episodes whose outcome differs from the one without a perturbation. A perturbation of the start
position alone would be forgotten on the way to the first waiting pose. The script prints a table and writes all
outcomes after each giver and condition; an interrupted measurement resumes with the same command.
"""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from handover_marl import __version__
from handover_marl.config import OFFICIAL_CONFIG, GiverConfig, WorldConfig
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.errors import OptionError
from handover_marl.evaluation.reports.statistics import compute_paired_difference
from handover_marl.evaluation.reports.tables import (
    NO_VALUE,
    format_percent_difference,
    format_percent_rate,
    format_table,
)
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.tasks import open_pool
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.policies.perturbed import PerturbedReceiver
from handover_marl.policies.policy import Policy
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, load_population
from handover_marl.policies.reference import parse_policy

# Entries of the output file by the name of the giver: policy, and outcomes by condition.
Entries = dict[str, dict[str, Any]]

NONE, PERTURBATION, START, NO_PREVIEW = "none", "perturbation", "start", "no preview"
# Policies that observe the preview of their recording; the other givers of the library ignore it.
_WITH_PREVIEW = ("learned", "cooperative")


@dataclass(frozen=True, kw_only=True)
class Args(EvaluationArgs):
    """Options of the measurement of controls.

    Attributes:
        out: JSON file of the outcomes; completed if it exists.
        population: Name of a shipped population, or path of a file.
        partners: Families of the population: train, test or all.
        names: Names of the givers to measure; default: all.
        receiver: The robot's policy.
        split: Split of the setup: train or val; the test split is for final results.
        n_scenes: Number of scenes, evenly spaced over the split.
        offset: Size of the perturbation of each joint target (rad) for the noise floor.
        n_perturbations: Number of perturbations of each scene, with different seeds.
        start_noise: Largest deviation of each joint (rad) in random start positions.
        trust: Allow policy files to run code.
    """

    out: Path
    population: str = DEFAULT_POPULATION
    partners: str = "all"
    names: tuple[str, ...] = ()
    receiver: str = "reactive"
    split: str = "train"
    n_scenes: int = 6
    offset: float = 1e-3
    n_perturbations: int = 3
    start_noise: float = 0.1
    trust: bool = False


@dataclass(frozen=True)
class Condition:
    """Condition under which the scenes are simulated.

    Attributes:
        kind: Kind of the condition.
        config: World and rules.
        offset: Size of the perturbation of each joint target (rad).
        seed: Seed of the signs of the perturbation; conditions of one kind differ in it.
    """

    kind: str
    config: WorldConfig = OFFICIAL_CONFIG
    offset: float = 0.0
    seed: int = 0

    @property
    def key(self) -> str:
        """Key of the condition in the output file."""
        return f"{self.kind} {self.seed}"


Task = tuple[Partner, Condition]


class ControlSimulator:
    """Simulator of the scenes with a giver under a condition, in one process.

    Args:
        args: Options of the script.
        scenes: Scene numbers.
    """

    def __init__(self, args: Args, scenes: Sequence[int]) -> None:
        self._args, self._scenes, self._data = args, scenes, args.open_dataset()
        self._population = load_population(args.population, args.trust)
        reference = parse_policy("receiver", args.receiver, args.trust)
        self._receiver = reference.make(self._data, OFFICIAL_CONFIG, args.setup)

    def simulate(self, task: Task) -> list[str]:
        """Simulate all scenes with a giver under a condition; return the outcome of every scene."""
        partner, condition = task
        reference = parse_policy("giver", self._population.get_policy(partner), self._args.trust)
        giver = reference.make(self._data, condition.config, self._args.setup)
        with contextlib.closing(Episode(self._args.physics, condition.config)) as episode:
            return [self._play(episode, giver, condition, number) for number in self._scenes]

    def _play(self, episode: Episode, giver: Policy, condition: Condition, number: int) -> str:
        receiver = PerturbedReceiver(self._receiver, condition.offset, (condition.seed, number))
        episode.reset(self._data.load_scene(number), number)
        run_episode(episode, receiver, giver, seed=0)
        return episode.status.label


def list_conditions(args: Args, partner: Partner) -> list[Condition]:
    """Return the conditions for a giver, the one without changes first."""
    conditions = [Condition(NONE)]
    conditions += [Condition(PERTURBATION, offset=args.offset, seed=seed) for seed in range(args.n_perturbations)]
    conditions.append(Condition(START, replace(OFFICIAL_CONFIG, initial_joint_noise=args.start_noise)))
    if partner.policy.partition(":")[0] in _WITH_PREVIEW:
        n_times = len(GiverConfig().preview)
        conditions.append(Condition(NO_PREVIEW, replace(OFFICIAL_CONFIG, giver=GiverConfig(preview=(0.0,) * n_times))))
    return conditions


def describe(args: Args, scenes: Sequence[int]) -> dict[str, Any]:
    """Return what the outcomes of all givers have in common."""
    names = ("setup", "split", "physics", "receiver", "offset", "start_noise")
    return {
        "version": __version__,
        "dataset": args.open_dataset().name,
        "scenes": list(scenes),
        **{key: value for key, value in asdict(args).items() if key in names},
    }


def read_entries(path: Path, setting: dict[str, Any], partners: Sequence[Partner]) -> Entries:
    """Return the entry of every giver: the one in an output file, or an empty one if the file has another policy.

    Raises:
        OptionError: The file was made with another setting.
    """
    stored = {}
    if path.is_file():
        content = json.loads(path.read_text())
        if content["setting"] != setting:
            raise OptionError(f"out must be a file with the same setting, got {path} with {content['setting']}")
        stored = content["givers"]
    empty = {partner.name: {"policy": partner.policy, "outcomes": {}} for partner in partners}
    return {
        name: stored[name] if stored.get(name, {}).get("policy") == entry["policy"] else entry
        for name, entry in empty.items()
    }


def select_outcomes(entry: dict[str, Any], kind: str) -> list[list[str]]:
    """Return the outcomes of all conditions of a kind, each a list with an outcome for every scene."""
    return [labels for key, labels in entry["outcomes"].items() if key.rpartition(" ")[0] == kind]


def count_changes(entries: Iterable[dict[str, Any]]) -> tuple[int, int]:
    """Count the perturbed episodes whose outcome differs from the unperturbed one, and all perturbed episodes."""
    pairs = [
        pair
        for entry in entries
        for usual in select_outcomes(entry, NONE)
        for perturbed in select_outcomes(entry, PERTURBATION)
        for pair in zip(usual, perturbed, strict=True)
    ]
    return sum(label != other for label, other in pairs), len(pairs)


def format_noise_floor(entries: Iterable[dict[str, Any]]) -> str:
    """Return the share of changed outcomes with interval, and the number of perturbed episodes."""
    changed, n = count_changes(entries)
    return f"{format_percent_rate(changed, n)}, n = {n}" if n else NO_VALUE


def format_controls(entries: Entries) -> str:
    """Return the table of all givers that were simulated, and of all together."""
    measured = {name: entry for name, entry in entries.items() if select_outcomes(entry, NONE)}
    groups = {**{name: [entry] for name, entry in measured.items()}, "all": list(measured.values())}
    header = ["giver", "success, %", "outcomes changed by a perturbation, %"]
    header += [f"{kind}: success gain, points" for kind in (START, NO_PREVIEW)]
    return format_table(header, [_format_row(name, group) for name, group in groups.items()], max_width=1000)


def _format_row(name: str, entries: Sequence[dict[str, Any]]) -> list[str]:
    usual = [label == _SUCCESS for entry in entries for label in select_outcomes(entry, NONE)[0]]
    cells = [name, format_percent_rate(sum(usual), len(usual)), format_noise_floor(entries)]
    for kind in (START, NO_PREVIEW):
        pairs = [
            (other == _SUCCESS, label == _SUCCESS)
            for entry in entries
            for changed in select_outcomes(entry, kind)
            for label, other in zip(select_outcomes(entry, NONE)[0], changed, strict=True)
        ]
        gain = format_percent_difference(compute_paired_difference(*zip(*pairs, strict=True))) if pairs else NO_VALUE
        cells.append(f"{gain}, n = {len(pairs)}" if pairs else gain)
    return cells


_SUCCESS = EpisodeStatus.SUCCESS.label


@contextlib.contextmanager
def _open_simulator(args: Args, scenes: Sequence[int]) -> Iterator[Callable[[Task], list[str]]]:
    yield ControlSimulator(args, scenes).simulate


def list_tasks(args: Args, partners: Sequence[Partner], entries: Entries) -> list[Task]:
    """Return what is left to simulate: a first perturbation of all givers before the second one."""
    tasks = [(partner, condition) for partner in partners for condition in list_conditions(args, partner)]
    missing = [(partner, each) for partner, each in tasks if each.key not in entries[partner.name]["outcomes"]]
    order = [condition.key for condition in list_conditions(args, replace(partners[0], policy=_WITH_PREVIEW[0]))]
    return sorted(missing, key=lambda task: max(1, order.index(task[1].key)))


def main(args: Args) -> None:
    """Simulate what the output file lacks, and print the table of all givers."""
    args = args.resolve_setup()
    scenes = select_scenes_evenly(args.open_dataset().list_scenes(args.setup, args.split), args.n_scenes)
    population = load_population(args.population, args.trust)
    setting = describe(args, scenes)
    entries = read_entries(args.out, setting, population.givers)
    partners = population.select("giver", args.partners)
    chosen = [partner for partner in partners if not args.names or partner.name in args.names]
    tasks = list_tasks(args, chosen, entries)
    found = open_pool(PoolConfig(args.workers)).map_unordered(
        lambda: _open_simulator(args, scenes), tasks, lambda task: f"simulating {task[0].name}, {task[1].key}"
    )
    with contextlib.closing(found):
        for index, outcomes in found:
            partner, condition = tasks[index]
            entries[partner.name]["outcomes"][condition.key] = outcomes
            write_atomically(args.out, json.dumps({"setting": setting, "givers": entries}) + "\n")
    print(format_controls(entries))
    print(
        f"\n{setting['setup']} {args.split}, {len(scenes)} scenes, receiver {args.receiver}, {setting['dataset']}, "
        f"{args.physics} physics, version {__version__}; perturbations of {args.offset:g} rad, start positions within "
        f"{args.start_noise:g} rad of the usual one. 95 % intervals: Wilson; Agresti and "
        "Min for differences, paired by scene."
    )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
