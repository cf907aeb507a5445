"""Commands that read result folders."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from handover_marl.cli.options import (
    DataDir,
    Folder,
    PopulationName,
    Progress,
    ReferencesFile,
    SceneNumbers,
    TableArguments,
    Trust,
    Workers,
)
from handover_marl.cli.streams import print_result, print_tables
from handover_marl.errors import OptionError, check_name
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path

_TABLES = TableArguments()
_Folders = Annotated[tuple[str, ...], tyro.conf.arg(metavar="DIR"), tyro.conf.Positional]


def run_evaluate(
    folder: Folder,
    /,
    out: Annotated[str | None, tyro.conf.arg(metavar="FILE.html")] = None,
    episodes: Annotated[str | None, tyro.conf.arg(metavar="FILE.csv")] = None,
    tables: TableArguments = _TABLES,
) -> None:
    """Print the table of a result folder, written by this library or by HandoverSim.

    Args:
        folder: Result folder (config.yaml and 000.npz, 001.npz, ...).
        out: Output file (.html) for the report as a web page; default: none.
        episodes: Output file (.csv) with one row per episode; default: none.
    """
    from handover_marl.evaluation.reports.report import evaluate, find_replay_links, render_report_page

    path, csv_path = _check_path(out, ".html"), _check_path(episodes, ".csv")
    report = evaluate(folder)
    if csv_path is not None:
        write_atomically(csv_path, report.format_episodes_csv())
    if path is not None:
        links = find_replay_links(Path(folder).expanduser(), path.parent)
        write_atomically(path, render_report_page(report, links))
    print_tables(report, tables, "Page not saved; add --out FILE.html." if path is None else f"Page: {path}")


def run_verify(
    folder: Folder,
    /,
    data_dir: DataDir = None,
    scenes: SceneNumbers = None,
    giver: Annotated[str | None, tyro.conf.arg(metavar="POLICY")] = None,
    workers: Workers = None,
    progress: Progress = True,
    trust: Trust = False,
    tables: TableArguments = _TABLES,
) -> int:
    """Verify a result folder: simulate its stored actions again and compare outcomes and metrics.

    The receiver's code is not needed. The exit status is 1 if anything differs, else 0.

    Args:
        folder: Result folder, written by this library or by HandoverSim.
        scenes: Scene numbers to verify, e.g. 209,214; default: all that have a result.
        giver: The person's policy; default: the registered policy that the folder names.
    """
    from handover_marl.evaluation.verification import COLUMNS, verify

    for column in tables.columns:
        check_name("column", column, COLUMNS)
    execution: Any = {"workers": workers, "progress": progress, "trust": trust}
    verification = verify(folder, data_dir=data_dir, scenes=scenes, giver=giver, **execution)
    print_tables(verification, tables, f"Folder: {Path(folder).expanduser()}")
    return int(not verification.is_verified)


def run_compare(
    first: Annotated[str, tyro.conf.arg(metavar="PATH")],
    second: Annotated[str, tyro.conf.arg(metavar="PATH")],
    /,
    tables: TableArguments = _TABLES,
) -> None:
    """Compare two evaluations scene by scene.

    Args:
        first: Result folder, or a file of docs/results/data/episodes.
        second: Result folder or file of the same setup, split and data.
    """
    from handover_marl.evaluation.comparison import compare

    print_tables(compare(first, second), tables)


def run_merge(folders: _Folders, out: Folder, tables: TableArguments = _TABLES) -> None:
    """Merge the result folders of all shards (--shard) into one, and print its table.

    Args:
        folders: Result folders of the shards, in any order.
        out: Result folder to create; it equals the folder of an evaluation without shards.
    """
    from handover_marl.evaluation.merge import merge
    from handover_marl.evaluation.reports.tables import TabularResult

    result, note = merge(folders, out), f"Results: {Path(out).expanduser()}"
    if isinstance(result, TabularResult):
        print_tables(result, tables, note)
    else:
        print_result(f"{result}\n\n{note}")


def run_convert(
    folder: Folder,
    /,
    to: Literal["minari", "lerobot"],
    name: Annotated[str, tyro.conf.arg(metavar="NAME")],
) -> None:
    """Convert demonstrations to a data set of another library, in the folder of that library.

    Args:
        folder: Output folder of `demonstrate`; for LeRobot one with a frame rate (--fps).
        to: Library that writes the data set, Minari or LeRobot.
        name: Name of the new data set, such as handover/reactive-v0.
    """
    if to == "minari":
        from handover_marl.evaluation.demonstrations.convert import convert_to_minari as convert
    else:
        from handover_marl.evaluation.demonstrations.convert import convert_to_lerobot as convert

    print_result(f"Data set: {convert(folder, name)}")


def run_strangers_table(
    folders: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=]DIR"), tyro.conf.Positional],
    population: PopulationName = "strangers-v1",
    references: ReferencesFile = None,
    heat_map: Annotated[str | None, tyro.conf.arg(metavar="FILE.png")] = None,
    trust: Trust = False,
    tables: TableArguments = _TABLES,
) -> None:
    """Print the leaderboard of folders that `strangers` wrote, one for each method and split of scenes.

    Args:
        folders: Output folders of `strangers` with the same partners, one for each method and split; all as NAME=DIR
            with the name of the method, or all as DIR, which are named by the label of the policy.
        heat_map: Picture to write, with the success rate of every method with every partner.
    """
    from handover_marl.evaluation.strangers.protocol import make_leaderboard

    paths, names = _split_names(folders)
    leaderboard = make_leaderboard(paths, population, references, names, trust)
    if heat_map is not None:
        leaderboard.write_heat_map(check_path("heat_map", heat_map))
    print_tables(leaderboard, tables, f"Folders: {', '.join(folders)}")


def _split_names(folders: tuple[str, ...]) -> tuple[list[str], list[str] | None]:
    """Return the folders without names, and their names if they are given as NAME=DIR, else None.

    Raises:
        OptionError: Only some have a name.
    """
    named = [folder.partition("=") for folder in folders if not Path(folder).expanduser().is_dir()]
    names = [name for name, sign, _ in named if sign]
    if not names:
        return list(folders), None
    if len(names) < len(folders) or "" in names:
        raise OptionError(f"folders must all have names, or none, got {' '.join(folders)}")
    return [folder for _, _, folder in named], names


def run_strangers_references(
    folders: _Folders,
    population: PopulationName = "strangers-v1",
    out: Annotated[str | None, tyro.conf.arg(metavar="FILE.json")] = None,
    trust: Trust = False,
    tables: TableArguments = _TABLES,
) -> None:
    """Update the best policies known for the partners of a population from result folders.

    Args:
        folders: Result folders, or folders that contain some.
        out: File of references to update; default: that of the population.
    """
    from handover_marl.evaluation.strangers.protocol import update_references

    table = update_references(folders, population, out, trust)
    path = table.population.references_path if out is None else Path(out).expanduser()
    print_tables(table, tables, f"References: {path}")


def _check_path(out: str | None, suffix: str) -> Path | None:
    if out is None:
        return None
    from handover_marl.visualization.video import check_output_path

    return check_output_path(out, (suffix,))
