"""Checks of a result folder that need no simulation: its reports and the giver's code."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from handover_marl import __version__
from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate, format_report_files
from handover_marl.evaluation.results.metadata import ResultMetadata
from handover_marl.evaluation.results.result_folder import REPORT_FILES, REPORT_JSON
from handover_marl.evaluation.verification.differences import Difference, compare_json
from handover_marl.execution.files import has_content, shorten_text
from handover_marl.execution.old_keys import upgrade_report
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.reference import PolicyReference

_MAX_REPORT_BYTES = 64_000_000


def check_giver(giver: PolicyReference, metadata: ResultMetadata) -> list[Difference]:
    """Compare label and code hash of the giver with the values in a result folder.

    Args:
        giver: Resolved giver that is simulated.
        metadata: Identity of the evaluation, as the folder states it.
    """
    found = [] if giver.label == metadata.giver else [Difference("giver", metadata.giver, giver.label)]
    if metadata.version == __version__ and metadata.giver_hash != giver.code_hash:
        found.append(Difference("giver_hash", metadata.giver_hash, giver.code_hash))
    return found


def check_reports(path: Path) -> list[Difference]:
    """Compare the reports in a result folder with reports that are computed from its result files.

    Args:
        path: Result folder. Texts and web pages of other versions are not compared. A folder without
            a report, such as a folder that HandoverSim wrote, has no differences.
    """
    try:
        report = evaluate(path)
    except ResultsError as error:
        return [Difference("results", shorten_text(error), "readable results")]
    is_same_version = report.metadata.version == __version__
    try:
        stored = upgrade_report(json.loads(read_plain_file(path / REPORT_JSON, _MAX_REPORT_BYTES)))
        n_resumed = stored["n_resumed"]
        report = replace(report, n_resumed=min(max(int(n_resumed), 0), len(report.episodes)))
        differences = _compare_report(stored, report)
    except FileNotFoundError:
        if not any((path / name).exists() for name in REPORT_FILES):
            return []
        differences = [Difference(REPORT_JSON, "missing", "a report")]
    except (OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        differences = [Difference(REPORT_JSON, shorten_text(error), "a report")]
    return [*differences, *(_compare_texts(path, report) if is_same_version else ())]


def _compare_texts(path: Path, report: Report) -> list[Difference]:
    """Compare text, web page and CSV file in a folder with those of a report; missing files are no difference."""
    differences = []
    for name, text in format_report_files(path, report).items():
        if name == REPORT_JSON or not (path / name).exists():
            continue
        try:
            found = "" if has_content(path / name, text.encode()) else "other text"
        except OSError as error:
            found = shorten_text(error)
        if found:
            differences.append(Difference(name, found, "the text of these results"))
    return differences


def _compare_report(stored: dict[str, Any], report: Report) -> list[Difference]:
    expected = json.loads(json.dumps(report.to_json()))
    # Other versions write fewer or other keys.
    differences = compare_json(stored, expected, same_keys=report.metadata.version == __version__)
    return [replace(difference, key=f"report.json: {difference.key}") for difference in differences]
