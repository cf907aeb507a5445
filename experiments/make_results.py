"""Make the results pages and their figure from stored evaluations.

    python experiments/make_results.py                              # pages and figure
    python experiments/make_results.py --add results/yang results/omg   # store these result folders first

`docs/results/data/episodes/` has a file with the outcome of every scene for each evaluation of a test split by the
official protocol (`handover-marl benchmark`). `--add` writes these files, and logs the use of the test split in
`test_use.csv`. Each template `docs/results/data/NAME.md.jinja` becomes the page `docs/results/NAME.md`. Differences are
computed by `handover-marl compare`.
"""

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from jinja2 import Environment, FileSystemLoader, StrictUndefined

import handover_marl
from handover_marl.episode.camera_observations import BENCHMARK_SENSORS
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.evaluation.reports.published import PUBLISHED, PublishedResult
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.tables import (
    AVERAGE_SUCCESS,
    N_EPISODES,
    RATES,
    TIMES,
    WAIT,
    compute_wilson_interval,
    format_csv,
    format_percent_rate,
)
from handover_marl.evaluation.results import format_episode_file

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "results"
DATA = FOLDER / "data"
EPISODES, TEST_USE = DATA / "episodes", DATA / "test_use.csv"
_TITLES = (column.title for column in (WAIT, N_EPISODES, *RATES, *TIMES, AVERAGE_SUCCESS))
HEADER = ("receiver", "setup", *_TITLES, "version")
OUTCOMES = tuple(column.key for column in RATES)
POSE, POSES = "true pose of the object", "true poses of all objects"
POSES_AND_HAND = f"{POSES} and of the hand"
#: Input of each receiver, and marker of this kind of input in the figure.
INPUTS = {
    "yang2021": (POSE, "o"),
    "omg": (POSES, "o"),
    "omg_unchecked_last": (POSES, "o"),
    "omg_hand_aware": (POSES_AND_HAND, "s"),
    "reactive": (f"{POSES_AND_HAND}; whether the object is released; validated grasps", "s"),
    "gaddpg": ("points of the object", "^"),
    "vision": ("points of objects and hand", "^"),
    "dagger": (f"{POSE} and of the hand; whether the object is released; validated grasps", "s"),
}
MARKERS = {
    "o": "true poses of objects",
    "s": "true poses of objects and hand\n(reactive, dagger: also the release)",
    "^": "point clouds",
}
#: Description of the benchmark's camera in result files: point clouds without noise.
OFFICIAL_CAMERA = BENCHMARK_SENSORS.describe("pointcloud", "exact")
#: By receiver, names (or parts of names) of the published methods that are compared with it.
METHODS = {"yang2021": ("Yang",), "omg": ("OMG",), "gaddpg": ("GA-DDPG",)}


@dataclass(frozen=True)
class Args:
    """Options of the generator of the results pages.

    Attributes:
        add: Result folders of complete evaluations to store first.
        purpose: Reason for the use of the test split, for the log `test_use.csv`.
        out: Folder for the pages and the figure.
    """

    add: tuple[Path, ...] = ()
    purpose: str = "table of results"
    out: Path = FOLDER


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a receiver on a whole test split by the official protocol.

    Attributes:
        report: Report on the outcomes of all scenes.
        path: File with these outcomes.
    """

    report: Report
    path: Path

    @property
    def receiver(self) -> str:
        """Name and options of the receiver, without the waiting time and the hash of its own weights."""
        name, _, options = re.sub("@own weights [0-9a-f]+", "", self.report.metadata.receiver).partition(":")
        return ":".join([name, *filter(None, [re.sub(r"wait=[\d.]+,?", "", options).strip(",")])])

    @property
    def name(self) -> str:
        """Name of the receiver, without options."""
        return self.receiver.partition(":")[0]

    @property
    def setup(self) -> str:
        """Official setup."""
        return self.report.metadata.setup

    @property
    def wait_s(self) -> float:
        """Time that the receiver waits at the start (s)."""
        return float(self.report.metadata.wait_s or 0.0)

    @property
    def counts(self) -> list[int]:
        """Numbers of successes, contacts, drops and timeouts."""
        return [self.report.count(status) for status in EpisodeStatus if status]

    @property
    def n_episodes(self) -> int:
        """Number of episodes."""
        return len(self.report.episodes)

    @property
    def conditions(self) -> str:
        """Text with physics, giver and data, for captions of tables."""
        return f"exact physics, giver `replay`, {self.report.data_label}"


def read_evaluations() -> list[Evaluation]:
    """Return all stored evaluations, in the order of their receivers in `INPUTS`."""
    found = [Evaluation(handover_marl.load_report(path), path) for path in sorted(EPISODES.glob("*.json"))]
    return sorted(found, key=lambda one: list(INPUTS).index(one.name))


def add_evaluation(folder: Path, purpose: str) -> None:
    """Store the outcomes of a complete official evaluation, and log the use of the test split; exit for another one."""
    report = handover_marl.load_report(folder)
    metadata = report.metadata
    protocol = (metadata.split, metadata.giver, metadata.simulation_label, metadata.inference_time)
    is_official = protocol == ("test", "replay", "exact physics", "") and metadata.camera in ("", OFFICIAL_CAMERA)
    if report.is_partial or not is_official:
        raise SystemExit(f"{folder} must be an evaluation by the official protocol on a whole test split")
    added = Evaluation(report, folder)
    EPISODES.mkdir(exist_ok=True)
    key = f"{added.receiver}-{metadata.dataset}-{metadata.setup}-{added.wait_s}"
    (EPISODES / f"{re.sub(r'[^a-z0-9.]+', '-', key)}.json").write_text(format_episode_file(metadata, report.episodes))
    split, version = f"{metadata.dataset} {metadata.setup}", metadata.version
    line = format_csv([[split, version, metadata.receiver, "replay, exact", added.n_episodes, purpose]])
    log = TEST_USE.read_text()
    TEST_USE.write_text(log if line in log else log + line)


def format_row(one: Evaluation) -> list[str]:
    """Return the cells of an evaluation's table row, in the order of `HEADER`."""
    means, metadata, n = one.report.official_means, one.report.metadata, one.n_episodes
    score = f"{100.0 * one.report.average_success:.1f} ({means['AS'].format_interval()})"
    version = f"[{metadata.version} ({metadata.receiver_hash})]({one.path.relative_to(FOLDER).as_posix()})"
    rates = [format_percent_rate(count, n, digits=2) for count in one.counts]
    executed, planned = means["exec_s"].mean, means["plan_s"].mean
    total = None if executed is None or planned is None else executed + planned
    times = ["" if value is None else f"{value:.3f}" for value in (executed, planned, total)]
    return [f"`{one.receiver}`", one.setup, f"{one.wait_s:g}", str(n), *rates, *times, score, version]


def format_published_row(row: PublishedResult, setup: str, episodes: int) -> list[str]:
    """Return the cells of a published result's table row in the order of `HEADER`; `episodes` is its episode count."""
    rates = [f"{value:.2f}" for value in (row.success, row.contact, row.drop, row.timeout)]
    times = [f"{value:.3f}" for value in (row.time_exec, row.time_plan, row.time_total)]
    start = [f"published: {row.method}", setup, f"{row.wait_s:g}", str(episodes)]
    return [*start, *rates, *times, f"{row.average_success:.1f}", ""]


def list_published(receiver: str, setup: str) -> list[PublishedResult]:
    """Return the results that HandoverSim published for a setup and the methods that are compared with a receiver."""
    methods = METHODS.get(receiver, ())
    rows = [row for row in PUBLISHED.get(setup, ()) if row.source == "HandoverSim"]
    return [row for row in rows if any(method in row.method for method in methods)]


def select_evaluations(
    evaluations: Iterable[Evaluation], receivers: tuple[str, ...], dataset: str = "dexycb"
) -> list[Evaluation]:
    """Return the evaluations of receivers on one data set; exit if they differ in objects or models of the scenes."""
    chosen = [one for one in evaluations if one.name in receivers and one.report.metadata.dataset == dataset]
    if len(conditions := {one.conditions for one in chosen}) > 1:
        raise SystemExit(f"evaluations of {receivers} are of different data: {sorted(conditions)}")
    return chosen


def make_table(evaluations: Iterable[Evaluation], receivers: tuple[str, ...], dataset: str = "dexycb") -> str:
    """Return a Markdown table of the test results of some receivers on one data set, and a line with their inputs.

    On DexYCB, the table also has the published results of the methods that are compared with the first receiver.
    """
    chosen = select_evaluations(evaluations, receivers, dataset)
    has_published, rows = dataset == "dexycb" and receivers[0] in METHODS, []
    for setup, wait in sorted({(one.setup, one.wait_s) for one in chosen}, key=lambda key: (-key[1], key[0])):
        group = [one for one in chosen if (one.setup, one.wait_s) == (setup, wait)]
        rows += [format_row(one) for one in group]
        published = list_published(receivers[0], setup) if has_published else []
        rows += [format_published_row(row, setup, group[0].n_episodes) for row in published if row.wait_s == wait]
    inputs: dict[str, list[str]] = {}
    for receiver in receivers:
        inputs.setdefault(INPUTS[receiver][0], []).append(f"`{receiver}`")
    listed = "; ".join(f"{', '.join(names)}: {words}" for words, names in inputs.items())
    note = " Published rows: all objects, MANO hands." if has_published else ""
    return f"{format_table(HEADER, rows)}\n\n*Test splits, {chosen[0].conditions}.{note} Input of {listed}.*"


def make_summary(evaluations: Iterable[Evaluation], setup: str) -> str:
    """Return a short Markdown table of the results of all receivers on a test split of DexYCB, with their inputs."""
    chosen = [one for one in select_evaluations(evaluations, tuple(INPUTS)) if one.setup == setup]
    header = ("receiver", "wait s", "success %", "n contact, drop, timeout", "AS %", "version", "input")
    rows = []
    for one in sorted(chosen, key=lambda one: (list(INPUTS).index(one.name), -one.wait_s)):
        cells = dict(zip(HEADER, format_row(one), strict=True))
        failures = ", ".join(map(str, one.counts[1:]))
        start = [cells[title] for title in header[:3]]
        rows.append([*start, failures, cells["AS %"], one.report.metadata.version, INPUTS[one.name][0]])
    caption = f"*{setup} test, {chosen[0].n_episodes} episodes a row, {chosen[0].conditions}; 95 % intervals.*"
    return f"{format_table(header, rows)}\n\n{caption}"


def make_difference_table(
    evaluations: Iterable[Evaluation], pairs: Sequence[tuple[str, float, str, float]], setups: tuple[str, ...] = ("s0",)
) -> str:
    """Return a Markdown table of paired differences of receivers on DexYCB's test splits, with commands to check them.

    Differences are A minus B on the same scenes. A row of `pairs` has receiver A, its wait (s), receiver B and its wait
    (s). A pair is left out if one of the two was not evaluated.
    """
    chosen = select_evaluations(evaluations, tuple(name for pair in pairs for name in pair[::2]))
    stored = {(one.setup, one.receiver, one.wait_s): one for one in chosen}
    rows, commands = [], []
    for setup, pair in itertools.product(setups, pairs):
        sides = [stored[key] for key in ((setup, *pair[:2]), (setup, *pair[2:])) if key in stored]
        if len(sides) < 2:
            continue
        paths = [one.path for one in sides]
        compared = handover_marl.compare(*paths)
        labels = [f"`{one.receiver}` ({one.wait_s:g} s, version {one.report.metadata.version})" for one in sides]
        gains = [str(row[3]) for row in compared.build_tables()[0].rows]
        rows.append([*labels, setup, str(len(compared.pairs)), *gains])
        files = [str(path.relative_to(FOLDER.parents[1])) for path in paths]
        commands.append(f"handover-marl compare {' '.join(files)}")
    header = ["A (wait)", "B (wait)", "setup", "n episodes", *(f"{name}, points" for name in (*OUTCOMES, "AS"))]
    text = f"*Differences A minus B, paired by scene, with 95 % intervals: test splits, {chosen[0].conditions}.*"
    return "\n".join([format_table(header, rows), "", text, "", "```bash", *commands, "```"])


def format_success(evaluations: Iterable[Evaluation], receiver: str, setup: str, wait_s: float) -> str:
    """Return a receiver's success rate on a test split of DexYCB as text, with interval, episodes and version."""
    chosen = select_evaluations(evaluations, (receiver,))
    (one,) = [one for one in chosen if (one.receiver, one.setup, one.wait_s) == (receiver, setup, wait_s)]
    rate, interval = format_percent_rate(one.counts[0], one.n_episodes).split(" ", 1)
    return f"{rate} % {interval} of {one.n_episodes} episodes with version {one.report.metadata.version}"


def make_failure_list(evaluations: Iterable[Evaluation], receiver: str) -> str:
    """Return a Markdown list of the scenes in which a receiver failed on test splits of DexYCB."""
    lines = []
    for one in select_evaluations(evaluations, (receiver,)):
        failed = [f"{each.scene_id} ({each.status.label})" for each in one.report.episodes if not each.success]
        version = one.report.metadata.version
        lines.append(f"- {one.setup}, wait {one.wait_s:g} s, version {version}: {', '.join(failed) or 'none'}")
    return "\n".join(lines)


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a header and rows of cells as a Markdown table."""
    head, *lines = (f"| {' | '.join(line)} |" for line in (header, *rows))
    return "\n".join([head, f"|{'---|' * len(header)}", *lines])


def render_pages(evaluations: list[Evaluation]) -> dict[str, str]:
    """Return the Markdown text of each results page by file name, rendered from the templates in `DATA`."""
    environment = Environment(loader=FileSystemLoader(DATA), undefined=StrictUndefined, keep_trailing_newline=True)
    values = {
        "table": lambda *args, **options: make_table(evaluations, *args, **options),
        "summary": lambda setup: make_summary(evaluations, setup),
        "differences": lambda *args, **options: make_difference_table(evaluations, *args, **options),
        "success": lambda *args: format_success(evaluations, *args),
        "failures": lambda *args: make_failure_list(evaluations, *args),
    }
    names = sorted(path.name for path in DATA.glob("*.md.jinja"))
    return {name.removesuffix(".jinja"): environment.get_template(name).render(values) for name in names}


def draw_figure(evaluations: list[Evaluation], path: Path) -> None:
    """Plot success rate and average success (AS) of all receivers on the s0 test split."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    own = [one for one in select_evaluations(evaluations, tuple(INPUTS)) if one.setup == "s0"]
    receivers = list(dict.fromkeys(one.name for one in own))
    colors = {receiver: f"C{number}" for number, receiver in enumerate(receivers)}
    with mpl.rc_context({"svg.hashsalt": "results", "svg.fonttype": "none", "font.size": 9}):
        figure, axes = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
        for one in own:
            low, high = compute_wilson_interval(one.counts[0], one.n_episodes)
            rate, color, marker = 100 * one.counts[0] / one.n_episodes, colors[one.name], INPUTS[one.name][1]
            fill, errors = color if one.wait_s else "white", [[rate - 100 * low], [100 * high - rate]]
            score = 100.0 * one.report.average_success
            axes.errorbar(score, rate, errors, capsize=2, linewidth=1, marker=marker, color=color, markerfacecolor=fill)
        for row, receiver in [(row, receiver) for row in PUBLISHED["s0"] for receiver in METHODS]:
            if row in list_published(receiver, "s0"):
                fill, marker = colors[receiver] if row.wait_s else "white", INPUTS[receiver][1]
                axes.plot(row.average_success, row.success, marker, color=fill, markeredgecolor="black")
        for receiver in receivers:
            axes.plot([], [], INPUTS[receiver][1], color=colors[receiver], label=receiver)
        for marker, label in MARKERS.items():
            axes.plot([], [], marker, color="0.7", label=f"input: {label}")
        axes.plot([], [], "o", color="0.3", label="filled: waits 3 s at the start")
        axes.plot([], [], "o", color="0.3", markerfacecolor="white", label="white: does not wait")
        axes.plot([], [], "o", color="0.7", markeredgecolor="black", label="black edge: published, AS derived")
        axes.set_xlabel("AS (%): success rate and time in one number")
        axes.set_ylabel("success rate (%)")
        axes.set_xlim(10, 80)
        axes.set_ylim(25, 105)
        axes.grid(alpha=0.3)
        figure.legend(loc="outside right upper", frameon=False)
        figure.savefig(path, format="svg", metadata={"Date": None})
        plt.close(figure)


def main(args: Args) -> None:
    """Store new evaluations, then write the results pages and their figure."""
    for folder in args.add:
        add_evaluation(folder, args.purpose)
    evaluations = read_evaluations()
    args.out.mkdir(parents=True, exist_ok=True)
    for name, text in render_pages(evaluations).items():
        (args.out / name).write_text(text)
    draw_figure(evaluations, args.out / "s0_test.svg")
    print(f"The results pages are in {args.out}")


if __name__ == "__main__":
    main(tyro.cli(Args))
