"""Measure which share of small changes of the code the tests detect (mutation testing).

    pip install cosmic-ray
    python experiments/mutation_testing.py --sample 40 --out runs/mutants

Every mutant is one change by Cosmic Ray, such as another operator, comparison or number. It is
tested with the unit tests of its module in a copy of the last commit. A mutant survives if these
tests pass. With --slow, survivors are also tested with the tests that `tests/slow.txt` lists. The
output folder gets a table and the differences of the survivors.

Survivors with the same behaviour as the original are listed with reasons in equivalent_mutants.txt. The
table has the share of detected mutants with and without them.
"""

import ast
import difflib
import importlib.util
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm

REPOSITORY = Path(__file__).resolve().parents[1]
Position = tuple[int, int]
EQUIVALENT_MUTANTS = Path(__file__).with_name("equivalent_mutants.txt")
# Exit status of pytest without tests.
NO_TESTS_COLLECTED = 5
# Between the differences of two survivors.
SEPARATOR = "\n\n"
REPORTS = ("tests/evaluation/reports",)
DATACLASSES = "tests/test_dataclasses.py"
FLUENCY = "tests/episode/metrics/test_fluency.py"
#: Unit tests of each module.
TESTS = {
    "handover_marl/episode/referee.py": ("tests/episode/test_protocol.py", "tests/episode/test_lockstep.py"),
    "handover_marl/episode/lockstep.py": ("tests/episode/test_simulate_worlds.py", "tests/episode/test_lockstep.py"),
    "handover_marl/episode/loop.py": ("tests/episode/test_clock.py", "tests/episode/test_play.py"),
    "handover_marl/episode/episode.py": ("tests/episode/test_episode.py", "tests/episode/test_play.py"),
    "handover_marl/episode/giver_motion.py": ("tests/episode/test_playback.py",),
    "handover_marl/episode/batch/giver_motion.py": ("tests/episode/batch/test_giver_motion.py", DATACLASSES),
    "handover_marl/episode/batch/wrist_offset.py": ("tests/episode/batch/test_giver_motion.py",),
    "handover_marl/episode/wrist_offset.py": ("tests/episode/test_playback.py", "tests/episode/test_set_points.py"),
    "handover_marl/episode/observations.py": ("tests/episode/test_observations.py", "tests/episode/test_playback.py"),
    "handover_marl/episode/camera_observations.py": ("tests/episode/test_camera_observations.py", DATACLASSES),
    "handover_marl/episode/spaces.py": ("tests/episode/test_spaces.py", DATACLASSES),
    "handover_marl/episode/callbacks.py": (FLUENCY, "tests/episode/test_play.py", DATACLASSES),
    "handover_marl/episode/metrics/fluency.py": (FLUENCY, DATACLASSES),
    "handover_marl/episode/metrics/motion_trace.py": (FLUENCY, DATACLASSES),
    "handover_marl/episode/metrics/motion_analysis.py": (FLUENCY,),
    "handover_marl/episode/metrics/arm_posture.py": ("tests/episode/metrics/test_arm_posture.py", DATACLASSES),
    "handover_marl/evaluation/comparison.py": ("tests/evaluation/test_comparison.py", *REPORTS, DATACLASSES),
    "handover_marl/evaluation/reports/statistics.py": (
        "tests/evaluation/reports/test_statistics.py",
        "tests/evaluation/reports/test_tables.py",
        DATACLASSES,
    ),
    "handover_marl/evaluation/reports/columns.py": (*REPORTS, DATACLASSES),
    "handover_marl/evaluation/reports/fluency_tables.py": REPORTS,
    "handover_marl/evaluation/reports/official_table.py": REPORTS,
    "handover_marl/evaluation/reports/pair_tables.py": (*REPORTS, "tests/evaluation/test_comparison.py"),
    "handover_marl/evaluation/reports/report.py": (*REPORTS, DATACLASSES),
    "handover_marl/evaluation/reports/scene_tables.py": REPORTS,
    "handover_marl/evaluation/reports/tables.py": (*REPORTS, DATACLASSES),
}


@dataclass(frozen=True)
class Args:
    """Options of mutation testing.

    Attributes:
        modules: Modules to change.
        sample: Number of mutants of each module that are drawn at random and tested; 0 tests all.
        seed: Seed of the random draw.
        slow: Whether survivors are tested with slow tests too.
        again: Whether to test only the survivors of an earlier run with the same sample, seed and output folder.
        timeout: Time after which tests count as failed, as a multiple of their time without a mutant.
        out: Folder for the table and the survivors.
    """

    modules: tuple[str, ...] = tuple(TESTS)
    sample: int = 40
    seed: int = 0
    slow: bool = False
    again: bool = False
    timeout: float = 5.0
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

    def count_equivalent(self, known: dict[str, set[str]]) -> int:
        """Return the number of survivors that are known to be equivalent to the original.

        Args:
            known: Changed lines of equivalent mutants by module.
        """
        return sum(extract_change(survivor) in known.get(self.module, set()) for survivor in self.survivors)


def find_annotations(source: str) -> list[tuple[Position, Position]]:
    """Return start and end of all type annotations, as pairs of line and column.

    Annotations are not tested: their mutants change nothing, or fail when the module is imported.
    """
    found: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.AnnAssign | ast.arg):
            found.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            found.append(node.returns)
    return [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        for node in found
        if node is not None
    ]


class TestRunner:
    """Runner of tests in child processes that are forked from a process with the tests' dependencies.

    A child imports the library and the tests anew, but not NumPy, SciPy and other packages.

    Args:
        copy: Folder with the copy of the repository; must be the working directory and on `sys.path`.
    """

    __test__ = False  # pytest must not collect this class

    def __init__(self, copy: Path) -> None:
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # mutants of the same size and second would share bytecode
        self._processes = multiprocessing.get_context("forkserver")
        self._processes.set_forkserver_preload(find_dependencies(copy))

    def passes(self, tests: Sequence[str], slow: bool = False, timeout: float | None = None) -> bool:
        """Return whether tests pass.

        Args:
            tests: Files or folders of the tests.
            slow: Whether to run the slow tests instead of the fast ones.
            timeout: Time after which tests count as failed (s); None: none.
        """
        options = ["-x", "-q", "-p", "no:cacheprovider", "-m", "slow" if slow else "not slow", *tests]
        process = self._processes.Process(target=run_pytest, args=(options,))
        process.start()
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
        return process.exitcode in (0, NO_TESTS_COLLECTED) if slow else process.exitcode == 0


def find_dependencies(copy: Path) -> list[str]:
    """Return the modules besides the repository's own that its tests import.

    Args:
        copy: Folder with the repository.
    """
    tests = sorted({test for group in TESTS.values() for test in group})
    code = (
        "import sys, pytest; "
        f"pytest.main(['-q', '--collect-only', '-p', 'no:cacheprovider', *{tests}]); "
        "print(*sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=copy, capture_output=True, text=True, check=True)
    own = ("handover_marl", "tests", "experiments", "conftest", "__main__")
    return [name for name in found.stdout.splitlines()[-1].split() if name.partition(".")[0] not in own]


def run_pytest(options: list[str]) -> None:
    """Run pytest without output and end the process with its exit status."""
    import pytest

    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.dup2(null, sys.stderr.fileno())
    sys.exit(int(pytest.main(options)))


def list_mutants(module: str, copy: Path) -> list[Any]:
    """Return all mutants of a module outside of type annotations, as Cosmic Ray's mutations.

    Args:
        module: Path of the module in the repository.
        copy: Folder with a copy of the repository; must be the working directory.
    """
    from cosmic_ray.commands.init import init
    from cosmic_ray.work_db import use_db

    with use_db(str(copy / f"{Path(module).stem}.sqlite")) as database:
        init([Path(module)], database, {})
        mutations = [item.mutations[0] for item in database.work_items]
    skipped = find_annotations((copy / module).read_text())
    return [mutation for mutation in mutations if not any(start <= mutation.start_pos < end for start, end in skipped)]


def measure_module(module: str, args: Args, copy: Path, runner: TestRunner) -> ModuleResult:
    """Test a sample of the mutants of a module and return the result.

    Args:
        module: Path of the module in the repository.
        args: Options of the script.
        copy: Folder with a copy of the repository; must be the working directory.
        runner: Runner of the tests.

    Raises:
        RuntimeError: The tests fail without a mutation.
    """
    from cosmic_ray.mutating import use_mutation
    from cosmic_ray.plugins import get_operator

    tests, times = TESTS[module], {}
    for slow in (False, True)[: 1 + args.slow]:
        start = time.monotonic()
        if not runner.passes(tests, slow):
            raise RuntimeError(f"the tests of {module} fail before it is changed: run pytest {' '.join(tests)}")
        times[slow] = args.timeout * (time.monotonic() - start)
    mutations, survivors = list_mutants(module, copy), []
    n_mutants = min(args.sample or len(mutations), len(mutations))
    earlier = {extract_change(text) for text in read_survivors(args.out, module)} if args.again else set()
    chosen = mutations if args.again else random.Random(args.seed).sample(mutations, n_mutants)
    n_found = 0
    for mutation in tqdm(chosen, desc=module, file=sys.stderr):
        operator = get_operator(mutation.operator_name)(**mutation.operator_args)
        with use_mutation(mutation.module_path, operator, mutation.occurrence) as (original, changed):
            difference = format_difference(original, changed)
            if args.again and extract_change(difference) not in earlier:
                continue
            n_found += 1
            if all(runner.passes(tests, slow, limit) for slow, limit in times.items()):
                survivors.append(difference)
    if n_found < len(earlier):
        raise RuntimeError(f"{module} has changed since the earlier run; run again without --again")
    return ModuleResult(module, n_mutants, survivors)


def extract_change(difference: str) -> str:
    """Return the changed lines of a unified diff, without line numbers and context."""
    return "\n".join(line for line in difference.splitlines()[2:] if line.startswith(("-", "+")))


def read_equivalent_mutants(path: Path = EQUIVALENT_MUTANTS) -> dict[str, set[str]]:
    """Read the changed lines of equivalent mutants by module.

    Args:
        path: File of paragraphs: the path of the module, the reason after `#`, and the changed lines.
    """
    known: dict[str, set[str]] = {}
    for paragraph in path.read_text().split("\n\n"):
        module, *lines = paragraph.strip().splitlines()
        known.setdefault(module, set()).add("\n".join(line for line in lines if not line.startswith("#")))
    return known


def build_rows(results: Sequence[ModuleResult], known: dict[str, set[str]]) -> list[list[object]]:
    """Build the rows of the table, of every module and of all.

    Args:
        results: Results of the modules.
        known: Changed lines of equivalent mutants by module.
    """
    from handover_marl.evaluation.reports.tables import format_percent_rate

    counts = [
        (one.module, one.n_mutants, one.n_mutants - len(one.survivors), one.count_equivalent(known)) for one in results
    ]
    counts.append(("all", *(sum(column) for column in list(zip(*counts, strict=True))[1:])))
    return [
        [module, n, f"{100 * found / n:.1f}", n_equivalent, format_percent_rate(found, n - n_equivalent)]
        for module, n, found, n_equivalent in counts
    ]


def name_survivors(out: Path, module: str) -> Path:
    """Return the file with the survivors of a module, e.g. `episode-loop.diff`."""
    path = Path(module)
    return out / f"{path.parent.name}-{path.stem}.diff"


def read_survivors(out: Path, module: str) -> list[str]:
    """Return the differences of the survivors of an earlier run."""
    text = name_survivors(out, module).read_text()
    return [part for part in text.split(SEPARATOR) if part]


def format_difference(original: str, changed: str) -> str:
    """Return the difference of two programs (unified diff)."""
    return "\n".join(difflib.unified_diff(original.splitlines(), changed.splitlines(), lineterm=""))


def measure_modules(args: Args) -> Iterator[ModuleResult]:
    """Test mutants of each module in a copy of the repository's last commit; yield the results."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        subprocess.run(["git", "clone", "--quiet", str(REPOSITORY), str(copy)], check=True)
        os.chdir(copy)  # Cosmic Ray takes relative paths of modules
        sys.path.insert(0, str(copy))  # children import the copy
        runner = TestRunner(copy)
        for module in args.modules:
            yield measure_module(module, args, copy, runner)
        os.chdir(REPOSITORY)


def main(args: Args) -> None:
    """Test the mutants and write the table and the survivors."""
    # Child processes import this file; they must not import modules before the tests do.
    from handover_marl.evaluation.reports.tables import format_table
    from handover_marl.execution.files import write_atomically

    if importlib.util.find_spec("cosmic_ray") is None:
        raise SystemExit("mutation testing needs Cosmic Ray: pip install cosmic-ray")
    unknown = set(args.modules) - set(TESTS)
    if unknown:
        raise SystemExit(f"modules must be of {', '.join(TESTS)}; got {', '.join(sorted(unknown))}")
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    args = replace(args, out=out)
    results = []
    for result in measure_modules(args):
        results.append(result)
        write_atomically(name_survivors(out, result.module), SEPARATOR.join(result.survivors).encode())
    header = ["module", "mutants", "detected %", "equivalent", "detected % of the others (95 % interval)"]
    table = format_table(header, build_rows(results, read_equivalent_mutants()))
    write_atomically(out / "mutants.md", f"{table}\n".encode())
    print(f"{table}\n\nSeed of the sample: {args.seed}. The survivors are in {out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
