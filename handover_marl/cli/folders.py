"""Commands that read result folders or demonstrations, and commands that create or check data folders."""

import functools
import os
import platform
import re
from collections import Counter
from importlib.metadata import distributions, metadata, requires
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import track

from handover_marl.cli.options import (
    DataDir,
    Folder,
    PopulationName,
    Progress,
    SceneNumbers,
    TableArguments,
    Trust,
    Workers,
)
from handover_marl.cli.streams import print_tables
from handover_marl.config import HAND_DOF, OBJECT_DOF, PANDA_DOF
from handover_marl.datasets import DATA_DIR_VARIABLE
from handover_marl.datasets.official import OfficialDataset
from handover_marl.datasets.splits import N_SCENES
from handover_marl.errors import HandoverError, OptionError
from handover_marl.evaluation.comparison import compare
from handover_marl.evaluation.demonstrations.convert import convert_to_lerobot, convert_to_minari
from handover_marl.evaluation.reports.report import ReportList, find_replay_links, load_report, render_report_page
from handover_marl.evaluation.strangers.protocol import make_leaderboard
from handover_marl.evaluation.verification import verify
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path
from handover_marl.geometry.model_files.meshes import check_model
from handover_marl.simulation.engines import EXACT, list_available_physics
from handover_marl.version import __version__
from handover_marl.visualization.pictures import prepare_output_path

#: Level ("ok", "note" or "fault"), name and text of the result of a check.
Finding = tuple[str, str, str]

_TABLES = TableArguments()
_FAULT, _MAX_LISTED = "fault", 20
_DISTRIBUTION, _DEVELOPER_EXTRAS = "handover-marl", ("assets", "dev", "docs")
_NAME, _EXTRA = re.compile(r"[\w.-]+"), re.compile(r"extra == ['\"](\w+)['\"]")


def run_report(
    folder: Annotated[str, tyro.conf.arg(metavar="PATH")],
    others: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[PATH ...]")] = (),
    /,
    out: Annotated[str | None, tyro.conf.arg(metavar="FILE.html")] = None,
    episodes: Annotated[str | None, tyro.conf.arg(metavar="FILE.csv")] = None,
    tables: TableArguments = _TABLES,
) -> None:
    """Print the tables of a result folder of this library or of HandoverSim, or one table of several folders.

    Args:
        folder: Result folder (config.yaml and 000.npz, 001.npz, ...), or a JSON file of outcomes such as those in
            docs/results/data/episodes.
        others: Further folders or files. The table then has a row for each.
        out: Output file (.html) for the report as a web page; default: none. Only for a single folder.
        episodes: Output file (.csv) with one row per episode; default: none. Only for a single folder.
    """
    if others and (out or episodes):
        raise OptionError("out and episodes need a single result folder; leave them out, or pass one folder")
    path = None if out is None else prepare_output_path(out, (".html",))
    csv_path = None if episodes is None else prepare_output_path(episodes, (".csv",))
    report, *more = map(load_report, (folder, *others))
    if csv_path is not None:
        write_atomically(csv_path, report.format_episodes_csv())
    if path is not None:
        links = find_replay_links(Path(folder).expanduser(), path.parent)
        write_atomically(path, render_report_page(report, links))
    result, advice = (ReportList((report, *more)), "") if more else (report, "Page not saved; add --out FILE.html.")
    print_tables(result, tables, advice if path is None else f"Page: {path}")


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
        scenes: Scene numbers to verify, e.g. 209,214; default: all scenes with a result.
        giver: The person's policy; default: the registered policy that the folder names.
    """
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
        first: Result folder, or a JSON file of outcomes such as those in docs/results/data/episodes.
        second: Result folder or file of the same setup, split and data.
    """
    print_tables(compare(first, second), tables)


def run_convert(
    folder: Folder, /, to: Literal["minari", "lerobot"], name: Annotated[str, tyro.conf.arg(metavar="NAME")]
) -> None:
    """Convert demonstrations to a data set of Minari or LeRobot, in the data folder of that library.

    Args:
        folder: Output folder of `demonstrate`; for LeRobot one with a frame rate (--fps).
        to: Library that writes the data set, Minari or LeRobot.
        name: Name of the new data set, such as handover/reactive-v0.
    """
    convert = convert_to_minari if to == "minari" else convert_to_lerobot
    print(f"Data set: {convert(folder, name)}", flush=True)


def run_strangers_table(
    folders: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME=]DIR"), tyro.conf.Positional],
    population: PopulationName = "strangers-v1",
    heat_map: Annotated[str | None, tyro.conf.arg(metavar="FILE.png")] = None,
    trust: Trust = False,
    tables: TableArguments = _TABLES,
) -> None:
    """Print the leaderboard of folders that `strangers` wrote, one for each method and split of scenes.

    Args:
        folders: Output folders of `strangers` with the same partners, one for each method and split; all as NAME=DIR
            with the name of the method, or all as DIR, for which the label of the policy is the name.
        heat_map: Picture to write, with the success rate of every method with every partner.
    """
    paths, names = _split_names(folders)
    leaderboard = make_leaderboard(paths, population, names, trust)
    if heat_map is not None:
        leaderboard.write_heat_map(check_path("heat_map", heat_map))
    print_tables(leaderboard, tables, f"Folders: {', '.join(folders)}")


def _split_names(folders: tuple[str, ...]) -> tuple[list[str], list[str] | None]:
    """Split arguments NAME=DIR into folders and names; the names are None if no argument has a name."""
    named = [folder.partition("=") for folder in folders if not Path(folder).expanduser().is_dir()]
    names = [name for name, sign, _ in named if sign]
    if not names:
        return list(folders), None
    if len(names) < len(folders) or "" in names:
        raise OptionError(f"folders must all have names, or none, got {' '.join(folders)}")
    return [folder for _, _, folder in named], names


def run_import(
    dexycb: Folder,
    mano: Folder,
    out: Folder,
    third_party: Annotated[str | None, tyro.conf.arg(metavar="DIR|ARCHIVE")] = None,
    scenes: SceneNumbers = None,
    workers: Workers = None,
    progress: Progress = True,
) -> int:
    """Create HandoverSim's data folder from raw DexYCB, MANO and HandoverSim's third-party archive.

    The exit status is 1 if no scene could be imported, else 0.

    Args:
        dexycb: Folder into which DexYCB's archives were unpacked.
        mano: Folder with MANO_RIGHT.pkl and MANO_LEFT.pkl.
        out: Data folder to create; an interrupted import resumes there.
        third_party: HandoverSim's assets-3rd-party archive, or the folder into which it was unpacked; default:
            substitutes from DexYCB's models, the library's grasps and PyBullet's Panda.
        scenes: Numbers of the scenes to import, e.g. 209,214; default: all.
    """
    from handover_marl.datasets.dexycb.importer import import_dexycb

    options: Any = {"third_party": third_party, "scenes": scenes, "workers": workers, "progress": progress}
    report = import_dexycb(dexycb, mano, out, **options)
    print(f"{report}\n\nData folder: {report.out}", flush=True)
    return int(not report.scenes)


def run_doctor(data_dir: DataDir = None, progress: Progress = True) -> int:
    """Check the installation and a data folder, and print the errors that an evaluation would raise.

    The exit status is 1 if there is a fault, else 0. Packages that are not installed, and stand-ins for HandoverSim's
    models, are no faults.
    """
    findings = check_installation()
    chosen = os.environ.get(DATA_DIR_VARIABLE) if data_dir is None else data_dir
    if chosen:
        findings += check_data_folder(check_path("data_dir", chosen), progress)
    else:
        findings.append(("ok", "data folder", f"none (--data-dir or {DATA_DIR_VARIABLE}); synthetic scenes are used"))
    # Names in damaged files may have control characters, which could change a terminal.
    lines = [f"{level:6}{name:16}{text}" for level, name, text in findings]
    print("\n".join("".join(c if c.isprintable() or c == "\n" else " " for c in line) for line in lines), flush=True)
    return int(any(level == _FAULT for level, *_ in findings))


def check_installation() -> list[Finding]:
    """Return findings (level, name, text) on library version, physics engines and packages of optional extras."""
    machine = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    findings = [("ok", "library", f"handover_marl {__version__}, {machine}")]
    available = list_available_physics()
    findings.append(("ok", "physics", ", ".join(available)))
    if EXACT not in available:
        text = "exact and fast need PyBullet, which has wheels up to Python 3.13; use --physics mujoco"
        findings.append(("note", "physics", text))
    missing: dict[str, list[str]] = {extra: [] for extra in metadata(_DISTRIBUTION).get_all("Provides-Extra", [])}
    for requirement in requires(_DISTRIBUTION) or []:
        name, extra = _NAME.match(requirement), _EXTRA.search(requirement)
        if name and extra and not any(distributions(name=name[0])):
            missing[extra[1]].append(name[0])
    for group in sorted(set(missing) - set(_DEVELOPER_EXTRAS)):
        text = f"without {', '.join(missing[group])}; to use it: pip install '{_DISTRIBUTION}[{group}]'"
        findings.append(("note", f"extra {group}", text) if missing[group] else ("ok", f"extra {group}", "complete"))
    return findings


def check_data_folder(data_dir: Path, progress: bool = False) -> list[Finding]:
    """Load all scenes of a data folder in HandoverSim's layout, with their models and grasps.

    Returns a `Finding` (level, name, text) for the scenes, with the errors, and one for each origin of models.
    """
    check_once = functools.cache(check_model)
    faults, models, n_complete = Counter[str](), Counter[str](), 0
    try:
        dataset = OfficialDataset(data_dir)
    except HandoverError as error:
        return [(_FAULT, "data folder", str(error))]
    for number in track(range(N_SCENES), "scenes", console=Console(stderr=True), disable=not progress, transient=True):
        try:
            scene = dataset.load_scene(number)
            dataset.load_grasps(scene.info.target_name)
            models[dataset.describe_models(number)] += 1
            assets = scene.assets
            parts = [(assets.table, 0), (assets.panda, PANDA_DOF), (assets.hand, HAND_DOF)]
            for urdf, n_joints in (*parts, *((urdf, OBJECT_DOF) for urdf in assets.objects)):
                check_once(urdf, n_joints)
            n_complete += 1
        except HandoverError as error:
            faults[str(error)] += 1
    listed = "".join(f"\n{'':6}-> {fault}" for fault, _ in faults.most_common(_MAX_LISTED))
    more = f"\n{'':6}-> and {len(faults) - _MAX_LISTED} more" if len(faults) > _MAX_LISTED else ""
    level = _FAULT if n_complete < N_SCENES else "ok"
    findings = [(level, "scenes", f"{n_complete} of {N_SCENES} in {data_dir}{listed}{more}")]
    return findings + [
        ("note" if "stand-in" in kind or "unknown" in kind else "ok", "models", f"{kind} in {count} scenes")
        for kind, count in models.most_common()
    ]
