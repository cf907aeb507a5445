"""Whether simulation ranks receivers as another measurement does, such as a study with a real robot.

    python experiments/rank_correlation.py --real study.csv
    python experiments/rank_correlation.py --real study.csv --simulated results/yang results/omg results/mine

`study.csv` has a line for each receiver: its name and its success there, in percent or as a share. Names are those of
HandoverSim's Table II, whose rows on the test split of `--setup` are taken as the simulation; with result folders they
are the receivers' names there. Prints both side by side with the rank correlations, and how much can be said from so
few receivers at all.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import tyro

from handover_marl.benchmarking.evaluation import evaluate
from handover_marl.benchmarking.published import PUBLISHED
from handover_marl.benchmarking.statistics import rank_correlation
from handover_marl.benchmarking.tables import percent_interval, table
from handover_marl.errors import OptionError
from handover_marl.protocol.status import EpisodeStatus


@dataclass(frozen=True)
class Args:
    """What is compared.

    Attributes:
        real: File with a line `name,success` for each receiver.
        simulated: Result folders, one a receiver; default: HandoverSim's Table II.
        setup: Whose published rows.
    """

    real: str
    simulated: tuple[str, ...] = ()
    setup: str = "s0"


def measured(path: Path) -> dict[str, float]:
    """Success by name.

    Raises:
        OptionError: The file cannot be read, or a line is no name and number.
    """
    found: dict[str, float] = {}
    try:
        lines = list(csv.reader(path.read_text().splitlines()))
    except (OSError, UnicodeDecodeError) as error:
        raise OptionError(f"--real {path}: cannot be read ({error})") from error
    for number, line in enumerate(lines, 1):
        try:
            name, value = line
            found[name.strip()] = float(value)
        except ValueError as error:
            raise OptionError(f"--real {path}, line {number}: {line} is not a name and a number") from error
    return found


def simulated(args: Args) -> dict[str, tuple[float, str]]:
    """Success in percent by name, and how it is told."""
    if not args.simulated:
        return {row.method: (row.success, f"{row.success:.2f}") for row in PUBLISHED[args.setup]}
    found = {}
    for folder in args.simulated:
        report = evaluate(folder)
        n, count = len(report.episodes), report.count(EpisodeStatus.SUCCESS)
        rate = 100.0 * report.success_rate
        found[report.settings.receiver] = (rate, f"{rate:.2f} ({percent_interval(count, n)}, {n} episodes)")
    return found


def main(args: Args) -> str:
    """The table and what it says.

    Raises:
        OptionError: Fewer than three receivers are in both.
    """
    real, other = measured(Path(args.real)), simulated(args)
    names = [name for name in real if name in other]
    if len(names) < 3:
        raise OptionError(f"only {names} are in both; simulated are {sorted(other)}. Three or more are needed")
    found = rank_correlation([real[name] for name in names], [other[name][0] for name in names])
    rows = [[name, f"{real[name]:g}", other[name][1]] for name in sorted(names, key=lambda name: -real[name])]
    least = f"a perfect agreement of {found.n} would be {100 * found.least_p:.1f} %."
    source = "simulated, success %" if args.simulated else f"published, {args.setup} test, success %"
    return (
        f"{table(['receiver', 'real', source], rows)}\n\n"
        f"Spearman {found.spearman:+.2f}, Kendall {found.kendall:+.2f}, {found.n} receivers. By chance as good or "
        f"better: {100 * found.p:.1f} % of all orders; {least}"
    )


if __name__ == "__main__":
    try:
        print(main(tyro.cli(Args)))
    except OptionError as error:
        raise SystemExit(f"rank_correlation: {error}") from None
