"""Compare the ranking of receivers in simulation with another ranking, e.g. of a real robot.

    python experiments/rank_correlation.py --real study.csv
    python experiments/rank_correlation.py --real study.csv --simulated results/yang results/omg results/mine

`study.csv` has a line for each receiver: its name and its success rate, in percent or as a fraction. By default,
simulated rates are HandoverSim's published ones (Table II, test split of `--setup`), under the names in that table;
with `--simulated` they are read from result folders. The script prints both rates side by side with the rank
correlations and a note on the small number of receivers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import stats

from handover_marl.errors import OptionError
from handover_marl.evaluation.reports.published import PUBLISHED
from handover_marl.evaluation.reports.report import evaluate
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.learning.training.scene_arguments import run_script


@dataclass(frozen=True)
class Args:
    """Options of the rank correlation between simulation and another study.

    Attributes:
        real: File with a line `name,success` for each receiver.
        simulated: Result folders, one per receiver; default: HandoverSim's Table II.
        setup: Official setup, s0 to s3, of the rows in Table II.
    """

    real: str
    simulated: tuple[str, ...] = ()
    setup: str = "s0"


def read_success_rates(path: Path) -> dict[str, float]:
    """Return the success rate of every receiver in the CSV file of a study, by name.

    Raises:
        OptionError: The file cannot be read, or a line does not contain a name and a number.
    """
    try:
        lines = np.loadtxt(path, dtype=str, delimiter=",", ndmin=2)
        return {name.strip(): float(value) for name, value in lines}
    except (OSError, ValueError) as error:
        raise OptionError(f"--real {path} must have a line name,success for each receiver ({error})") from error


def load_simulated_rates(args: Args) -> dict[str, tuple[float, str]]:
    """Return the simulated success rate (%) of every receiver, and the text of its table cell, by its name."""
    if not args.simulated:
        return {row.method: (row.success, f"{row.success:.2f}") for row in PUBLISHED[args.setup]}
    found = {}
    for folder in args.simulated:
        report = evaluate(folder)
        n, rate, interval = len(report.episodes), 100.0 * report.success_rate, report.rates["success"].format_interval()
        found[report.metadata.receiver] = (rate, f"{rate:.2f} ({interval}, {n} episodes)")
    return found


def compute_rank_correlation(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """Return Spearman's rho of two lists of rates, and the share of permutations with at least this rho."""

    def compute_rho(permuted: npt.NDArray[np.float64]) -> float:
        return float(stats.spearmanr(first, permuted).statistic)

    options = {"permutation_type": "pairings", "alternative": "greater", "n_resamples": np.inf}
    test = stats.permutation_test((np.asarray(second),), compute_rho, vectorized=False, **options)
    return float(test.statistic), float(test.pvalue)


def main(args: Args) -> str:
    """Return a table of the simulated and the measured success rates, with their rank correlations.

    Raises:
        OptionError: Fewer than three receivers are in both rankings.
    """
    real, other = read_success_rates(Path(args.real)), load_simulated_rates(args)
    names = [name for name in real if name in other]
    if len(names) < 3:
        raise OptionError(f"only {names} are in both; simulated are {sorted(other)}. Three or more are needed")
    first, second = [real[name] for name in names], [other[name][0] for name in names]
    spearman, p = compute_rank_correlation(first, second)
    _, min_p = compute_rank_correlation(sorted(first), sorted(second))
    kendall = stats.kendalltau(first, second).statistic
    rows = [[name, f"{real[name]:g}", other[name][1]] for name in sorted(names, key=lambda name: -real[name])]
    least = f"a perfect agreement of {len(names)} would be {100 * min_p:.1f} %."
    source = "simulated, success %" if args.simulated else f"published, {args.setup} test, success %"
    return (
        f"{format_table(['receiver', 'real', source], rows)}\n\n"
        f"Spearman {spearman:+.2f}, Kendall {kendall:+.2f}, {len(names)} receivers. By chance as good or "
        f"better: {100 * p:.1f} % of all orders; {least}"
    )


if __name__ == "__main__":
    print(run_script(main, Args))
