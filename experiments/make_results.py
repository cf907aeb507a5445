"""Make the results page and its figure from stored evaluations.

    python experiments/make_results.py                              # page and figure
    python experiments/make_results.py --add results/yang results/omg   # store these result folders first

`docs/results/data/evaluations.json` has one entry for each evaluation of a test split: receiver,
data set, setup, version of the library, and counts of outcomes. `--add` replaces the entry of an
evaluation by the content of a result folder. The other tables of the page are read from CSV files
in the same folder, written by the scripts that the page names.
"""

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from jinja2 import Environment, FileSystemLoader, StrictUndefined

import handover_marl
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.published import PUBLISHED, PublishedResult
from handover_marl.evaluation.reports.statistics import compute_wilson_interval
from handover_marl.evaluation.results.metadata import OFFICIAL_WORLD

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "results"
DATA = FOLDER / "data"
HEADER = (
    "receiver",
    "setup",
    "wait s",
    "n episodes",
    "success %",
    "exec s",
    "plan s",
    "total s",
    "contact %",
    "drop %",
    "timeout %",
    "AS %",
    "version",
)
#: Published methods that are compared with each receiver.
METHODS = {"yang2021": ("Yang",), "omg": ("OMG",), "gaddpg": ("GA-DDPG",)}


@dataclass(frozen=True)
class Args:
    """Options of the generator of the results page.

    Attributes:
        add: Result folders of complete test splits to store first.
        out: Folder for the page and the figure.
    """

    add: tuple[Path, ...] = ()
    out: Path = FOLDER


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a receiver on a test split with the giver `replay` in exact physics.

    Attributes:
        receiver: Name of the receiver.
        dataset: "dexycb" (grasped object only, stand-in hand) or "synthetic".
        setup: Official setup.
        split: Split of the setup.
        wait_s: Time that the receiver waits at the start (s).
        episodes: Number of episodes.
        success: Number of successes.
        contact: Number of episodes with a contact of robot and hand.
        drop: Number of drops.
        timeout: Number of timeouts.
        exec_s: Mean execution time of the successes (s).
        as_percent: Average success (AS): mean over all episodes of 1 - t / 13 s for a success at
            time t and 0 for a failure, in percent.
        version: Version of the library.
        plan_s: Mean wall-clock time of the policy in successes (s), or None if it was not stored.
    """

    receiver: str
    dataset: str
    setup: str
    split: str
    wait_s: float
    episodes: int
    success: int
    contact: int
    drop: int
    timeout: int
    exec_s: float
    as_percent: float
    version: str
    plan_s: float | None = None

    @property
    def key(self) -> tuple[str, str, str, str, float]:
        """Receiver, dataset, setup, split and waiting time, which identify an evaluation."""
        return self.receiver, self.dataset, self.setup, self.split, self.wait_s

    def format_rate(self, name: str) -> str:
        """Return the rate of an outcome with its 95 % Wilson interval (%), as text.

        Args:
            name: Field with the number of episodes: success, contact, drop or timeout.
        """
        count = getattr(self, name)
        low, high = compute_wilson_interval(count, self.episodes)
        return f"{100 * count / self.episodes:.2f} ({100 * low:.1f} to {100 * high:.1f})"


def read_evaluations() -> list[Evaluation]:
    """Return the evaluations stored in `evaluations.json`."""
    return [Evaluation(**entry) for entry in json.loads((DATA / "evaluations.json").read_text())]


def read_evaluation(folder: Path) -> Evaluation:
    """Return the evaluation whose results are stored in a result folder.

    Raises:
        SystemExit: The folder is not a complete, official evaluation of a test split.
    """
    report = handover_marl.evaluate(folder)
    metadata = report.metadata
    conditions = (metadata.split, metadata.giver, metadata.physics, metadata.world)
    if conditions != ("test", "replay", "exact", OFFICIAL_WORLD) or report.is_partial:
        raise SystemExit(f"{folder} must be an official evaluation of a whole test split")
    n = {status: report.count(status) for status in EpisodeStatus}
    return Evaluation(
        receiver=metadata.receiver.partition(":")[0],
        dataset=metadata.dataset,
        setup=metadata.setup,
        split=metadata.split,
        wait_s=float(metadata.wait_s or 0.0),
        episodes=len(report.episodes),
        success=n[EpisodeStatus.SUCCESS],
        contact=n[EpisodeStatus.HUMAN_CONTACT],
        drop=n[EpisodeStatus.OBJECT_DROP],
        timeout=n[EpisodeStatus.TIMEOUT],
        exec_s=round(float(report.time_exec or 0.0), 3),
        as_percent=round(100 * report.average_success, 1),
        version=metadata.version,
        plan_s=round(float(report.time_plan or 0.0), 3),
    )


def write_evaluations(evaluations: Iterable[Evaluation]) -> None:
    """Write evaluations to `evaluations.json`, in place of its present content."""
    text = json.dumps([asdict(evaluation) for evaluation in evaluations], indent=1)
    (DATA / "evaluations.json").write_text(f"{text}\n")


def format_row(evaluation: Evaluation) -> list[str]:
    """Return the cells of the table row of an evaluation that was made with this library."""
    rates = [evaluation.format_rate(name) for name in ("success", "contact", "drop", "timeout")]
    start = [f"`{evaluation.receiver}`", evaluation.setup, f"{evaluation.wait_s:g}", str(evaluation.episodes)]
    end = [f"{evaluation.as_percent:.1f}", evaluation.version]
    plan_s = evaluation.plan_s
    planning = ["", ""] if plan_s is None else [f"{plan_s:.3f}", f"{evaluation.exec_s + plan_s:.3f}"]
    return [*start, rates[0], f"{evaluation.exec_s:.3f}", *planning, *rates[1:], *end]


def format_published_row(row: PublishedResult, setup: str, episodes: int) -> list[str]:
    """Return the cells of the table row of a published result.

    Args:
        row: Published result.
        setup: Official setup of the result.
        episodes: Number of episodes of the test split.
    """
    cells = [f"{value:.2f}" for value in (row.contact, row.drop, row.timeout)]
    start = [f"published: {row.method}", setup, f"{row.wait_s:g}", str(episodes), f"{row.success:.2f}"]
    times = [f"{value:.3f}" for value in (row.time_exec, row.time_plan, row.time_total)]
    return [*start, *times, *cells, f"{row.average_success:.1f}", ""]


def make_setup_table(evaluations: list[Evaluation], receivers: tuple[str, ...], dataset: str = "dexycb") -> str:
    """Return a Markdown table of the results of some receivers, with the published results.

    Args:
        evaluations: All stored evaluations.
        receivers: Names of the receivers in the table.
        dataset: Dataset of the evaluations in the table.
    """
    chosen = [one for one in evaluations if one.receiver in receivers and one.dataset == dataset]
    rows = []
    for setup, wait in sorted({(one.setup, one.wait_s) for one in chosen}, key=lambda key: (-key[1], key[0])):
        group = [one for one in chosen if (one.setup, one.wait_s) == (setup, wait)]
        rows += [format_row(one) for one in group]
        methods = METHODS.get(receivers[0], ()) if dataset == "dexycb" else ()
        rows += [
            format_published_row(row, setup, group[0].episodes)
            for row in PUBLISHED[setup]
            if row.wait_s == wait and row.source == "HandoverSim" and any(method in row.method for method in methods)
        ]
    return format_table(HEADER, rows)


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with header and rows as Markdown text."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def make_csv_table(name: str) -> str:
    """Return a CSV file of the folder `docs/results/data` as a Markdown table."""
    header, *rows = csv.reader((DATA / name).read_text().splitlines())
    return format_table(header, rows)


def render_page(evaluations: list[Evaluation]) -> str:
    """Return the Markdown text of the results page."""
    environment = Environment(loader=FileSystemLoader(DATA), undefined=StrictUndefined, keep_trailing_newline=True)
    template = environment.get_template("index.md.jinja")
    return template.render(
        evaluations=evaluations,
        table=lambda *args, **kw: make_setup_table(evaluations, *args, **kw),
        csv_table=make_csv_table,
    )


def draw_figure(evaluations: list[Evaluation], path: Path) -> None:
    """Plot success rate and average success (AS) of all receivers on the s0 test split."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    own = [one for one in evaluations if (one.dataset, one.setup, one.split) == ("dexycb", "s0", "test")]
    receivers = list(dict.fromkeys(one.receiver for one in own))
    colors = {receiver: f"C{number}" for number, receiver in enumerate(receivers)}
    with mpl.rc_context({"svg.hashsalt": "results", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
        for one in own:
            low, high = compute_wilson_interval(one.success, one.episodes)
            rate, color = 100 * one.success / one.episodes, colors[one.receiver]
            fill = color if one.wait_s else "white"
            errors = [[rate - 100 * low], [100 * high - rate]]
            axes.errorbar(
                one.as_percent, rate, errors, marker="o", color=color, markerfacecolor=fill, capsize=2, linewidth=1
            )
        for row in PUBLISHED["s0"]:
            for receiver, methods in METHODS.items():
                if row.source == "HandoverSim" and any(method in row.method for method in methods):
                    marker = "X" if row.wait_s else "x"
                    axes.plot(row.average_success, row.success, marker, color=colors[receiver])
        for receiver in receivers:
            axes.plot([], [], "o", color=colors[receiver], label=receiver)
        axes.plot([], [], "o", color="0.3", label="waits 3 s at the start")
        axes.plot([], [], "o", color="0.3", markerfacecolor="white", label="does not wait")
        axes.plot([], [], "X", color="0.3", label="published (wait 3 s)")
        axes.plot([], [], "x", color="0.3", label="published (no wait)")
        axes.set_xlabel("AS (%): success rate and time in one number")
        axes.set_ylabel("success rate (%)")
        axes.set_xlim(10, 80)
        axes.set_ylim(25, 105)
        axes.grid(alpha=0.3)
        figure.legend(loc="outside right upper", frameon=False)
        figure.savefig(path, format="svg", metadata={"Date": None})
        plt.close(figure)


def main(args: Args) -> None:
    """Store new evaluations, then write the results page and its figure."""
    stored = {one.key: one for one in read_evaluations()}
    if args.add:
        stored |= {one.key: one for one in map(read_evaluation, args.add)}
        write_evaluations(stored.values())
    evaluations = list(stored.values())
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "index.md").write_text(render_page(evaluations))
    draw_figure(evaluations, args.out / "s0_test.svg")
    print(f"The results page is {args.out / 'index.md'}")


if __name__ == "__main__":
    main(tyro.cli(Args))
