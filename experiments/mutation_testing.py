"""Measure which share of small changes of the code the tests detect (mutation testing).

    pip install cosmic-ray
    python experiments/mutation_testing.py --sample 100 --out runs/mutants

Every mutant is one change by Cosmic Ray, such as another operator, comparison or number. It is
tested with the unit tests of its module in a copy of the repository. A mutant survives if these
tests pass. The output folder gets a table and the differences of the survivors.
"""

import ast
import importlib.util
import os
import random
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from handover_marl.errors import OptionError
from handover_marl.evaluation.reports.tables import format_percent_rate, format_table
from handover_marl.execution.files import write_atomically

REPOSITORY = Path(__file__).resolve().parents[1]
#: Unit tests of each module.
TESTS = {
    "handover_marl/episode/referee.py": ("tests/episode/test_protocol.py",),
    "handover_marl/episode/loop.py": ("tests/episode/test_play.py",),
    "handover_marl/episode/giver_motion.py": ("tests/episode/test_playback.py", "tests/episode/test_clock.py"),
    "handover_marl/episode/metrics.py": ("tests/episode/test_fluency.py",),
    "handover_marl/evaluation/comparison.py": ("tests/evaluation/test_comparison.py",),
    "handover_marl/evaluation/reports/statistics.py": ("tests/evaluation/reports/test_statistics.py",),
    "handover_marl/evaluation/reports/tables.py": ("tests/evaluation/reports",),
    "handover_marl/evaluation/reports/scene_tables.py": ("tests/evaluation/reports",),
    "handover_marl/evaluation/reports/report.py": ("tests/evaluation/reports",),
}


@dataclass(frozen=True)
class Args:
    """Options of mutation testing.

    Attributes:
        modules: Modules to change.
        sample: Number of mutants of each module that are drawn at random and tested; 0 tests all.
        seed: Seed of the random draw.
        timeout: Time after which tests count as failed (s).
        out: Folder for the table and the survivors.
    """

    modules: tuple[str, ...] = tuple(TESTS)
    sample: int = 100
    seed: int = 0
    timeout: float = 120.0
    out: Path = Path("runs/mutants")


@dataclass(frozen=True)
class ModuleResult:
    """Result of testing the mutants of one module.

    Attributes:
        module: Path of the module in the repository.
        n_mutants: Number of mutants that were tested.
        survivors: Differences (unified diff) of the mutants that passed all tests.
    """

    module: str
    n_mutants: int
    survivors: list[str]


def find_annotation_lines(source: str) -> set[int]:
    """Return the numbers of the lines that only annotate a name, without a value.

    Such lines are not executed, so that no test can detect their mutants.
    """
    nodes = ast.walk(ast.parse(source))
    return {node.lineno for node in nodes if isinstance(node, ast.AnnAssign) and node.value is None}


def measure_module(module: str, args: Args, copy: Path) -> ModuleResult:
    """Test a sample of the mutants of a module and return the result.

    Args:
        module: Path of the module in the repository.
        args: Options of the script.
        copy: Folder with a copy of the repository; must be the working directory.
    """
    from cosmic_ray.commands.init import init
    from cosmic_ray.mutating import mutate_and_test
    from cosmic_ray.work_db import use_db
    from cosmic_ray.work_item import TestOutcome

    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *TESTS[module]]
    if subprocess.run(command, cwd=copy, capture_output=True, check=False).returncode:
        raise OptionError(f"modules must have tests that pass before they are changed, got {module!r}: run {command}")
    with use_db(str(copy / "mutants.sqlite")) as database:
        init([Path(module)], database, {})
        items = list(database.work_items)
    skipped = find_annotation_lines((copy / module).read_text())
    items = [item for item in items if item.mutations[0].start_pos[0] not in skipped]
    if args.sample and args.sample < len(items):
        items = random.Random(args.seed).sample(items, args.sample)
    survivors = []
    for item in tqdm(items, desc=module, file=sys.stderr):
        result = mutate_and_test(item.mutations, shlex.join(command), args.timeout)
        if result.test_outcome is TestOutcome.SURVIVED:
            survivors.append(str(result.diff))
    return ModuleResult(module, len(items), survivors)


def measure_modules(args: Args) -> Iterator[ModuleResult]:
    """Test mutants of each module in a copy of the repository's last commit; yield the results."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        subprocess.run(["git", "clone", "--quiet", str(REPOSITORY), str(copy)], check=True)
        os.chdir(copy)  # Cosmic Ray takes relative paths of modules
        for module in args.modules:
            yield measure_module(module, args, copy)
        os.chdir(REPOSITORY)


def main(args: Args) -> None:
    """Test the mutants and write the table and the survivors."""
    if importlib.util.find_spec("cosmic_ray") is None:
        raise SystemExit("mutation testing needs Cosmic Ray: pip install cosmic-ray")
    unknown = set(args.modules) - set(TESTS)
    if unknown:
        raise SystemExit(f"modules must be of {', '.join(TESTS)}; got {', '.join(sorted(unknown))}")
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    results = []
    for result in measure_modules(args):
        results.append(result)
        name = Path(result.module).stem
        write_atomically(out / f"{name}.diff", "\n\n".join(result.survivors).encode())
    rows = [
        [one.module, one.n_mutants, format_percent_rate(one.n_mutants - len(one.survivors), one.n_mutants)]
        for one in results
    ]
    n_mutants, n_survivors = sum(one.n_mutants for one in results), sum(len(one.survivors) for one in results)
    rows.append(["all", n_mutants, format_percent_rate(n_mutants - n_survivors, n_mutants)])
    table = format_table(["module", "mutants", "detected % (95 % interval)"], rows)
    write_atomically(out / "mutants.md", f"{table}\n".encode())
    print(f"{table}\n\nThe survivors are in {out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
