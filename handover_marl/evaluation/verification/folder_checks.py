"""Checks of a result folder that need no simulation: its reports and the giver's code."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from handover_marl import __version__
from handover_marl.errors import ResultsError
from handover_marl.evaluation.reports.report import Report
from handover_marl.evaluation.reports.report_files import evaluate
from handover_marl.evaluation.reports.scene_tables import format_episodes_csv
from handover_marl.evaluation.results.metadata import ResultMetadata
from handover_marl.evaluation.results.result_folder import EPISODES_CSV
from handover_marl.evaluation.verification.differences import Difference, compare_json
from handover_marl.execution.files import has_content, shorten_text
from handover_marl.execution.old_keys import upgrade_report
from handover_marl.execution.reading import read_plain_file
from handover_marl.policies.reference import PolicyReference

_MAX_REPORT_BYTES = 64_000_000


def check_giver(giver: PolicyReference, metadata: ResultMetadata) -> list[Difference]:
    """Compare label and code of the giver with those that a folder names.

    Args:
        giver: Resolved giver that is simulated.
        metadata: Identity of the evaluation, as the folder states it.
    """
    found = [] if giver.label == metadata.giver else [Difference("giver", metadata.giver, giver.label)]
    if metadata.version == __version__ and metadata.giver_hash != giver.code_hash:
        found.append(Difference("giver_hash", metadata.giver_hash, giver.code_hash))
    return found


def check_reports(path: Path) -> list[Difference]:
    """Compare `report.json`, `report.md` and `episodes.csv` with the reports of the result files beside them.

    Args:
        path: Result folder. Missing reports, and texts of other versions, are not compared.
    """
    try:
        report = evaluate(path)
    except ResultsError as error:
        return [Difference("results", shorten_text(error), "readable results")]
    try:
        stored = upgrade_report(json.loads(read_plain_file(path / "report.json", _MAX_REPORT_BYTES)))
        n_resumed = stored["n_resumed"]
        report = replace(report, n_resumed=min(max(int(n_resumed), 0), len(report.episodes)))
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        return [Difference("report.json", shorten_text(error), "a report")]
    differences = _compare_report(stored, report)
    episodes = format_episodes_csv(report.metadata, report.episodes)
    for name, text in (("report.md", report.to_markdown()), (EPISODES_CSV, episodes)):
        is_comparable = report.metadata.version == __version__ and (path / name).is_file()
        if is_comparable and not has_content(path / name, text.encode()):
            differences.append(Difference(name, "other text", "the text of these results"))
    return differences


def _compare_report(stored: dict[str, Any], report: Report) -> list[Difference]:
    expected = json.loads(json.dumps(report.to_json()))
    # Other versions write fewer or other keys.
    differences = compare_json(stored, expected, same_keys=report.metadata.version == __version__)
    return [replace(difference, key=f"report.json: {difference.key}") for difference in differences]
