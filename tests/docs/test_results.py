"""The pages of results agree with the stored outcomes, and every printed interval with its rate."""

import json
import math
import re
import statistics
from pathlib import Path

import pytest

from experiments import make_results
from tests.docs.pages import REPOSITORY, checked_table, name

RESULTS = REPOSITORY / "docs" / "results"
#: Pages whose rates have Wilson intervals; the intervals on the other pages are bootstrap intervals.
RATE_PAGES = [page for page in sorted(RESULTS.glob("*.md")) if not page.name.startswith(("strangers", "population"))]
_RATE = re.compile(r"(?<![\d.+-])(\d+\.\d+)(?: %)? \((\d+\.\d+) to (\d+\.\d+)\)")
#: Titles of columns with intervals of other kinds.
_NO_RATES = re.compile(r"AS %|idle|delay|handover s|s per scene|points|mean")
_OUTCOMES = ("success", "contact", "drop", "timeout")
#: Numbers of scenes of the official test splits.
SIZES = {"s0": 144, "s1": 180, "s2": 360, "s3": 100}


def compute_interval(count: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval in percent, by its formula."""
    z, p = 1.959963984540054, count / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return 100 * max(0.0, middle - half) / (1 + z * z / n), 100 * min(1.0, (middle + half) / (1 + z * z / n))


def format_rate(count: int, n: int, digits: int) -> tuple[str, str, str]:
    low, high = compute_interval(count, n)
    return f"{100 * count / n:.{digits}f}", f"{low:.1f}", f"{high:.1f}"


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def find_wrong_intervals(text: str) -> tuple[list[str], int]:
    """Return rates whose interval belongs to no number of episodes in their section, and the number of rates."""
    wrong, n_rates = [], 0
    for section in re.split(r"(?m)^#+ ", text):
        numbers = {int(number) for number in re.findall(r"(?<![\d.,])\d{2,3}(?![\d.,]*\d)", section)}
        header: list[str] = []
        for line in section.splitlines():
            is_row = line.startswith("|")
            row = cells(line) if is_row else [line]
            header = (header or row) if is_row else []
            titled = list(zip(header, row, strict=True)) if is_row else [("", line)]
            own = [int(cell) for title, cell in titled if title in ("n episodes", "episodes") and cell.isdigit()]
            for title, cell in titled:
                for found in () if _NO_RATES.search(title) else _RATE.findall(cell):
                    digits, n_rates = len(found[0].partition(".")[2]), n_rates + 1
                    possible = [(round(float(found[0]) * n / 100), n) for n in own or numbers]
                    if not any(format_rate(count, n, digits) == found for count, n in possible if count <= n):
                        wrong.append(f"{found} in {line[:80]}")
    return wrong, n_rates


@pytest.mark.parametrize("page", RATE_PAGES, ids=name)
def test_intervals_belong_to_their_rates(page: Path) -> None:
    assert find_wrong_intervals(page.read_text())[0] == []


def test_a_wrong_interval_is_found() -> None:
    table = "| a | episodes | success % |\n|---|---|---|\n| b | 144 | 98.61 (95.1 to 99.{}) |\n\n"
    table += "36 scenes: 97.2 % ({} to 99.5)"
    assert find_wrong_intervals(table.format(6, 85.8)) == ([], 2)
    assert len(find_wrong_intervals(table.format(7, 85.8))[0]) == 1
    assert len(find_wrong_intervals(table.format(6, 85.9))[0]) == 1
    assert len(find_wrong_intervals(table.format(6, 85.8).replace("144", "145"))[0]) == 1
    assert sum(find_wrong_intervals(page.read_text())[1] for page in RATE_PAGES) > 150


@pytest.mark.slow
def test_pages_are_made_from_stored_outcomes_of_whole_splits() -> None:
    evaluations = make_results.read_evaluations()
    for one in evaluations:
        assert one.n_episodes == SIZES[one.setup]
    pages = make_results.render_pages(evaluations)
    assert {"index.md", "reactive.md", "tables.md"} <= {*pages}
    for page, text in pages.items():
        assert text == (RESULTS / page).read_text(), f"{page} differs; run experiments/make_results.py"


def list_outcome_rows(folder: Path) -> list[tuple[dict[str, str], Path]]:
    """Return the cells by title of each row with stored outcomes on the pages in a folder, and its file."""
    found = []
    for page in sorted(folder.glob("*.md")):
        header: list[str] = []
        for line in page.read_text().splitlines():
            row = cells(line)
            header = row if "version" in row else header
            if link := re.search(r"\]\((data/episodes/[^)]+)\)", row[-1]):
                found.append((dict(zip(header, row, strict=True)), folder / link[1]))
    return found


def check_outcome_row(row: dict[str, str], path: Path) -> None:
    """Check every number of a row against the stored outcomes, with formulas that are written here."""
    content = json.loads(path.read_text())
    episodes = [dict(zip(content["columns"], row, strict=True)) | content["common"] for row in content["episodes"]]
    n, flags = len(episodes), [episode["outcome"] for episode in episodes]
    assert int(row["n episodes"]) == n
    for label in _OUTCOMES:
        count = sum(label in flag.split("+") for flag in flags)
        assert _RATE.findall(row[f"{label} %"]) == [format_rate(count, n, 2)], label
    times = [(episode["steps"] / 1000, episode["plan_s"]) for episode in episodes if episode["outcome"] == "success"]
    for title, value in (
        ("exec s", statistics.fmean(time for time, _ in times)),
        ("plan s", statistics.fmean(time for _, time in times)),
        ("total s", statistics.fmean(sum(pair) for pair in times)),
        ("AS %", 100 * sum(1 - time / 13 for time, _ in times) / n),
    ):
        assert float(row[title].partition(" ")[0]) == pytest.approx(value, abs=0.0006 if title != "AS %" else 0.051)
    metadata = content["metadata"]
    assert row["version"].startswith(f"[{metadata['version']} ({metadata['receiver_hash']})]")


def test_rows_with_stored_outcomes_are_recomputed() -> None:
    for row, path in list_outcome_rows(RESULTS):
        check_outcome_row(row, path)


def test_readme_states_the_rate_of_the_figure_and_the_input() -> None:
    text = " ".join((REPOSITORY / "README.md").read_text().split())
    chosen = make_results.select_evaluations(make_results.read_evaluations(), ("reactive",))
    (shown,) = [one for one in chosen if (one.setup, one.wait_s) == ("s0", 0.0)]
    assert f"`reactive` ({100 * shown.counts[0] / shown.n_episodes:.1f} %) reads true poses of objects and hand" in text


def test_inputs_are_those_of_the_table_of_policies() -> None:
    """The kinds of input in the tables and the figure follow from the tested table of the page policies."""
    page = REPOSITORY / "docs" / "reference" / "policies.md"
    rows = {row[0]: row[1:] for row in checked_table(page, "receiver inputs")}
    for number, receiver in enumerate(("yang2021", "omg", "omg_hand_aware", "reactive", "gaddpg", "vision")):
        used = {name for name, row in rows.items() if row[number] == "yes"}
        words, marker = make_results.INPUTS[receiver]
        has_hand = "true pose and joints of the hand" in used
        assert marker == ("^" if "true pose of that object" not in used else "s" if has_hand else "o")
        assert ("all objects" in words) == ("true poses of the other objects" in used)
        assert ("release" in words) == ("the simulator's `released` flag" in used)
        assert ("hand" in words) == (has_hand or "point cloud of the hand, perfect segmentation" in used)
