"""Commands that read result folders, without simulating."""

from pathlib import Path
from typing import Annotated

import tyro

from handover_marl.execution.files import write_atomically

_PagePath = Annotated[str | None, tyro.conf.arg(metavar="FILE.html")]


def run_evaluate(folder: Annotated[str, tyro.conf.arg(metavar="DIR")], /, out: _PagePath = None) -> None:
    """Print the table of a result folder, written by this library or by HandoverSim.

    Args:
        folder: Result folder (config.yaml and 000.npz, 001.npz, ...).
        out: Output file (.html) for the report as a web page; default: none.
    """
    from handover_marl.evaluation.reports.report_files import evaluate

    path = _check_page_path(out)
    report = evaluate(folder)
    print(report)
    if path is not None:
        from handover_marl.evaluation.reports.pages import find_replay_links, render_report_page

        links = find_replay_links(Path(folder).expanduser(), path.parent)
        _write_page(path, render_report_page(report, links))


def run_compare(
    first: Annotated[str, tyro.conf.arg(metavar="DIR")],
    second: Annotated[str, tyro.conf.arg(metavar="DIR")],
    /,
    out: _PagePath = None,
) -> None:
    """Compare two result folders scene by scene.

    Args:
        first: Result folder.
        second: Result folder of the same setup, split and data.
        out: Output file (.html) for the comparison as a web page; default: none.
    """
    from handover_marl.evaluation.comparison import compare

    path = _check_page_path(out)
    comparison = compare(first, second)
    print(comparison)
    if path is not None:
        from handover_marl.evaluation.comparison import render_comparison_page
        from handover_marl.evaluation.reports.pages import find_replay_links

        one, other = (find_replay_links(Path(side).expanduser(), path.parent) for side in (first, second))
        _write_page(path, render_comparison_page(comparison, (one, other)))


def run_merge(
    folders: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DIR"), tyro.conf.Positional],
    out: Annotated[str, tyro.conf.arg(metavar="DIR")],
) -> None:
    """Merge the result folders of all shards (--shard) into one, and print its table.

    Args:
        folders: Result folders of the shards, in any order.
        out: Result folder to create, equal to that of an evaluation without shards.
    """
    from handover_marl.evaluation.merge import merge

    print(f"{merge(folders, out)}\n\nResults: {Path(out).expanduser()}")


def _write_page(path: Path, page: str) -> None:
    write_atomically(path, page)
    print(f"\nPage: {path}")


def _check_page_path(out: str | None) -> Path | None:
    if out is None:
        return None
    from handover_marl.visualization.film import check_output_path

    return check_output_path(out, (".html",))
