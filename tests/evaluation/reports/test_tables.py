"""Tests of tables in all formats, and of statistics with their intervals."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest

import handover_marl
from handover_marl.cli import main
from handover_marl.evaluation.comparison import Comparison
from handover_marl.evaluation.crossplay import CrossPlay
from handover_marl.evaluation.reports.tables import (
    TABLE_FORMATS,
    Estimate,
    ReportTable,
    TabularResult,
    compute_wilson_interval,
    estimate_mean,
    estimate_paired_difference,
)
from tests.evaluation.quick import write_results
from tests.evaluation.reports.test_report import report

WIDE = ReportTable(["giver", "receiver", *(f"column_{n} %" for n in range(9))], [["a_b", "50 %", *["x & y"] * 9]], 0, 2)


def test_parts_of_a_wide_table_repeat_its_key_columns() -> None:
    parts = str(WIDE).split("\n\n")
    assert len(parts) > 1
    for part in parts:
        assert [cell.strip() for cell in part.splitlines()[0].split("|")[1:3]] == ["giver", "receiver"]
        assert max(map(len, part.splitlines())) <= 100


@pytest.mark.parametrize("kind", ["report", "comparison", "crossplay"])
def test_every_result_has_every_format(kind: str) -> None:
    first, other = report(1, 2), report(2, 1, physics="fast")
    results: dict[str, TabularResult] = {"report": first, "comparison": Comparison(first, other)}
    results |= {"crossplay": CrossPlay({("replay", name): first for name in ("hold", "yang2021")})}
    result = results[kind]
    sections = result.build_sections()
    tables = [section for section in sections if isinstance(section, ReportTable) and section.rows]
    texts = [section for section in sections if isinstance(section, str) and section]
    assert tables
    assert texts
    assert str(result) == result.format("markdown")
    assert result.format("csv").split("\n\n") == [table.format("csv") for table in tables]
    latex = result.format("latex")
    assert latex.count("\\begin{tabular}") == len(tables)
    for text in texts:
        assert all(f"% {line}" in latex.splitlines() for line in text.splitlines())


def test_stdout_of_a_command_is_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The standard output in CSV or LaTeX has the result only; notes are printed to the standard error."""
    folder = write_results(tmp_path)
    for table_format in TABLE_FORMATS:
        expected = handover_marl.load_report(folder).format(table_format)
        assert main(["report", str(folder), "--format", table_format]) == 0
        printed = capsys.readouterr()
        note = "Page not saved; add --out FILE.html.\n"
        if table_format == "markdown":
            assert printed.out == f"{expected}\n\n{note}"
        else:
            assert (printed.out, printed.err) == (f"{expected}\n", f"handover-marl: {note}")


def test_episodes_as_csv(tmp_path: Path) -> None:
    """The CSV file has one row for each episode, with the keys and values of report.json."""
    folder = write_results(tmp_path / "run")
    made = handover_marl.load_report(folder)
    content = made.to_json()
    assert main(["report", str(folder), "--episodes", str(tmp_path / "all.csv")]) == 0
    text = (tmp_path / "all.csv").read_text()
    assert text == made.format_episodes_csv()
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == 2
    for row, stored in zip(rows, content["episodes"], strict=True):  # type: ignore[call-overload]
        values = {**content, **stored, **stored["fluency"]}
        assert row == {key: "" if values[key] is None else str(values[key]) for key in row}
        missing = {*stored, *stored["fluency"]} - {*row}
        assert missing == {"fluency"}
    assert main(["report", str(folder), "--episodes", str(tmp_path / "all.txt")]) == 2


def test_wilson_against_known_values() -> None:
    # Newcombe (1998), Table I: 81/263 and 0/20.
    np.testing.assert_allclose(compute_wilson_interval(81, 263), (0.2553, 0.3662), atol=5e-5)
    np.testing.assert_allclose(compute_wilson_interval(0, 20), (0.0, 0.1611), atol=5e-5)


def test_means() -> None:
    # One of the 27 resamples of three values has the lowest mean and one the highest; 1/27 is more than 2.5 %.
    assert estimate_mean([1.0, 2.0, 3.0]) == Estimate(2.0, (1.0, 3.0), 3)
    assert estimate_mean([1.0]) == Estimate(1.0, None, 1)
    assert estimate_mean([]) == Estimate(None, None, 0)
    # The 2000 resamples are fixed, so that later versions reproduce the intervals of the results pages.
    values = np.random.default_rng(2).normal(5.0, 2.0, 25)
    resamples = np.random.default_rng(0).integers(0, 25, (2000, 25))
    expected = np.percentile(values[resamples].mean(axis=1), [2.5, 97.5])
    np.testing.assert_allclose(estimate_mean(values.tolist()).interval_95, expected, rtol=1e-12)


def test_paired_differences() -> None:
    """The intervals are those of worked examples.

    First Agresti, Categorical Data Analysis: 150 of 1600 approved only first, 86 only later. Then 4 of 10 scenes that
    only the first solves, and 1 that only the second solves, which count as 4.5 and 1.5 of 12.
    """
    first = [True] * 794 + [True] * 150 + [False] * 86 + [False] * 570
    second = [True] * 794 + [False] * 150 + [True] * 86 + [False] * 570
    found = estimate_paired_difference(first, second)
    assert found.mean == pytest.approx(0.04)
    assert found.interval_95 == pytest.approx((0.021, 0.059), abs=1e-3)
    found = estimate_paired_difference([True] * 4 + [False] + [True] * 5, [False] * 4 + [True] + [True] * 5)
    half = 1.959964 * (((4.5 + 1.5) / 12 - (3 / 12) ** 2) / 12) ** 0.5
    assert found.mean == pytest.approx(0.3)
    assert found.interval_95 == pytest.approx((0.25 - half, 0.25 + half), abs=1e-5)
