"""A report as files beside the official results."""

import json
from pathlib import Path

from handover_marl.benchmarking.report import Report
from handover_marl.benchmarking.report_page import replay_links, report_page
from handover_marl.benchmarking.tables import report_markdown
from handover_marl.files import write_atomically


def write_report(folder: Path, report: Report) -> None:
    """Write `report.json`, `report.md` and `report.html`, which leads to the replays that are there.

    Raises:
        ResultsError: The folder cannot be written.
    """
    write_atomically(folder / "report.json", json.dumps(report.to_json(), indent=2, allow_nan=False) + "\n")
    write_atomically(folder / "report.md", report_markdown(report))
    write_atomically(folder / "report.html", report_page(report, replay_links(folder, folder)))
