"""Commands that read result folders and play nothing."""

from pathlib import Path
from typing import Annotated

import tyro

from handover_marl.files import write_atomically

_Page = Annotated[str | None, tyro.conf.arg(metavar="FILE.html")]


def run_evaluate(folder: Annotated[str, tyro.conf.arg(metavar="DIR")], /, out: _Page = None) -> None:
    """Print the table of an official result folder, ours or the original authors'.

    Args:
        folder: The result folder (config.yaml and 000.npz, 001.npz, ...).
        out: An .html file for the report as a page, too.
    """
    from handover_marl.benchmarking.evaluation import evaluate

    path = _page_path(out)
    report = evaluate(folder)
    print(report)
    if path is not None:
        from handover_marl.benchmarking.report_page import replay_links, report_page

        write_atomically(path, report_page(report, replay_links(Path(folder).expanduser(), path.parent)))


def run_compare(
    first: Annotated[str, tyro.conf.arg(metavar="DIR")],
    second: Annotated[str, tyro.conf.arg(metavar="DIR")],
    /,
    out: _Page = None,
) -> None:
    """Compare two result folders scene by scene, without playing anything.

    Args:
        first: A result folder.
        second: Another one, of the same setup, split and data.
        out: An .html file for the comparison as a page, too.
    """
    from handover_marl.benchmarking.comparison import compare

    path = _page_path(out)
    comparison = compare(first, second)
    print(comparison)
    if path is not None:
        from handover_marl.benchmarking.report_page import comparison_page, replay_links

        one, other = (replay_links(Path(side).expanduser(), path.parent) for side in (first, second))
        write_atomically(path, comparison_page(comparison, (one, other)))


def run_merge(
    folders: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DIR"), tyro.conf.Positional],
    out: Annotated[str, tyro.conf.arg(metavar="DIR")],
) -> None:
    """Make one folder of the folders of all shards of a run (--shard), and print what the run would have printed.

    Args:
        folders: The folders of the shards, in any order.
        out: The folder to make: as the run would have written it.
    """
    from handover_marl.merging.merge import merge

    print(merge(folders, out))


def _page_path(out: str | None) -> Path | None:
    if out is None:
        return None
    from handover_marl.pictures.rendering import checked_path

    return checked_path(out, (".html",))
