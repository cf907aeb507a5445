"""Commands that read result folders."""

from pathlib import Path
from typing import Annotated

import tyro

from handover_marl.cli.options import SceneNumbers
from handover_marl.cli.streams import print_result
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
    print_result(report)
    if path is not None:
        from handover_marl.evaluation.reports.pages import find_replay_links, render_report_page

        links = find_replay_links(Path(folder).expanduser(), path.parent)
        write_atomically(path, render_report_page(report, links))
    _print_page_path(path)


def run_verify(
    folder: Annotated[str, tyro.conf.arg(metavar="DIR")],
    /,
    data_dir: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None,
    scenes: SceneNumbers = None,
    giver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    progress: bool = True,
    trust: bool = False,
) -> int:
    """Verify a result folder: simulate its stored actions again and compare outcomes and metrics.

    The receiver's code is not needed. The exit status is 1 if anything differs, else 0.

    Args:
        folder: Result folder, written by this library or by HandoverSim.
        data_dir: Data folder in HandoverSim's layout; default: the environment variable
            HANDOVER_MARL_DATA.
        scenes: Scene numbers to verify, e.g. 209,214; default: all that have a result.
        giver: The person's policy; default: the registered policy that the folder names.
        workers: Number of worker processes; default: one per core.
        progress: Show a progress bar on stderr.
        trust: Allow policy files (learned:FILE) to run code.
    """
    from handover_marl.evaluation.verification.verify import verify

    verification = verify(
        folder,
        data_dir=data_dir,
        scenes=scenes,
        giver=giver,
        workers=workers,
        progress=progress,
        trust=trust,
    )
    print_result(f"{verification}\n\nFolder: {Path(folder).expanduser()}")
    return int(not verification.is_verified)


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
    print_result(comparison)
    if path is not None:
        from handover_marl.evaluation.comparison import render_comparison_page
        from handover_marl.evaluation.reports.pages import find_replay_links

        one, other = (find_replay_links(Path(side).expanduser(), path.parent) for side in (first, second))
        write_atomically(path, render_comparison_page(comparison, (one, other)))
    _print_page_path(path)


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

    print_result(f"{merge(folders, out)}\n\nResults: {Path(out).expanduser()}")


def _print_page_path(path: Path | None) -> None:
    """Print, as the last line, the path of the page."""
    print_result("\nPage not saved; add --out FILE.html." if path is None else f"\nPage: {path}")


def _check_page_path(out: str | None) -> Path | None:
    if out is None:
        return None
    from handover_marl.visualization.film import check_output_path

    return check_output_path(out, (".html",))
