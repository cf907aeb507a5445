"""Commands that create and check data folders."""

import functools
import os
import platform
import re
from collections import Counter
from importlib.metadata import distributions, metadata, requires
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import track

from handover_marl.cli.options import DataDir, Folder, Progress, SceneNumbers, Workers
from handover_marl.cli.streams import print_result
from handover_marl.config import HAND_DOF, OBJECT_DOF, PANDA_DOF
from handover_marl.errors import HandoverError
from handover_marl.execution.options import check_path
from handover_marl.version import __version__

#: Level ("ok", "note" or "fault"), name and result of a check.
Finding = tuple[str, str, str]

_FAULT, _MAX_LISTED = "fault", 20
_DISTRIBUTION, _DEVELOPER_EXTRAS = "handover-marl", ("assets", "dev", "docs")
_NAME, _EXTRA = re.compile(r"[\w.-]+"), re.compile(r"extra == ['\"](\w+)['\"]")


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
        third_party: HandoverSim's assets-3rd-party archive, or the folder into which it was
            unpacked; default: substitutes from DexYCB's models, the library's grasps and PyBullet's
            Panda.
        scenes: Numbers of the scenes to import, e.g. 209,214; default: all.
    """
    from handover_marl.datasets.dexycb.importer import import_dexycb

    report = import_dexycb(
        dexycb, mano, out, third_party=third_party, scenes=scenes, workers=workers, progress=progress
    )
    print_result(f"{report}\n\nData folder: {report.out}")
    return int(not report.scenes)


def run_doctor(data_dir: DataDir = None, progress: Progress = True) -> int:
    """Check the installation and a data folder, with the errors that an evaluation would raise.

    The exit status is 1 if there is a fault, else 0. Stand-ins for HandoverSim's models are not faults.
    """
    from handover_marl.datasets import DATA_DIR_VARIABLE

    findings = check_installation()
    chosen = os.environ.get(DATA_DIR_VARIABLE) if data_dir is None else data_dir
    if chosen:
        findings += check_data_folder(check_path("data_dir", chosen), progress)
    else:
        findings.append(("ok", "data folder", f"none (--data-dir or {DATA_DIR_VARIABLE}); synthetic scenes are used"))
    # Names in damaged files may have control characters, which could change a terminal.
    lines = [f"{level:6}{name:16}{text}" for level, name, text in findings]
    print_result("\n".join("".join(c if c.isprintable() or c == "\n" else " " for c in line) for line in lines))
    return int(any(level == _FAULT for level, *_ in findings))


def check_installation() -> list[Finding]:
    """Return findings on the library's version, the physics engines and the packages of the optional extras."""
    from handover_marl.simulation.engines import EXACT, list_available_physics

    machine = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    findings = [("ok", "library", f"handover_marl {__version__}, {machine}")]
    available = list_available_physics()
    text = ", ".join(available) or "none; install PyBullet (Python up to 3.13) or MuJoCo (Python from 3.11)"
    findings.append(("ok" if available else _FAULT, "physics", text))
    if available and EXACT not in available:
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

    Returns a finding for the scenes, with the errors, and one for each kind of models.
    """
    from handover_marl.datasets.official import OfficialDataset
    from handover_marl.datasets.splits import N_SCENES
    from handover_marl.geometry.model_files.meshes import check_model

    @functools.cache
    def find_fault(urdf: Path, n_joints: int) -> str:
        try:
            check_model(urdf, n_joints)
        except HandoverError as error:
            return str(error)
        return ""

    faults, models, n_complete = Counter[str](), Counter[str](), 0
    try:
        dataset = OfficialDataset(data_dir)
    except HandoverError as error:
        return [(_FAULT, "data folder", str(error))]
    for number in track(range(N_SCENES), "scenes", console=Console(stderr=True), disable=not progress, transient=True):
        found = []
        try:
            scene = dataset.load_scene(number)
            assets = scene.assets
            parts = [(assets.table, 0), (assets.panda, PANDA_DOF), (assets.hand, HAND_DOF)]
            found = [find_fault(*part) for part in (*parts, *((urdf, OBJECT_DOF) for urdf in assets.objects))]
            dataset.load_grasps(scene.info.target_name)
            models[dataset.describe_models(number)] += 1
        except HandoverError as error:
            found.append(str(error))
        faults.update(filter(None, found))
        n_complete += not any(found)
    listed = "".join(f"\n{'':6}-> {fault}" for fault, _ in faults.most_common(_MAX_LISTED))
    more = f"\n{'':6}-> and {len(faults) - _MAX_LISTED} more" if len(faults) > _MAX_LISTED else ""
    level = _FAULT if n_complete < N_SCENES else "ok"
    findings = [(level, "scenes", f"{n_complete} of {N_SCENES} in {data_dir}{listed}{more}")]
    return findings + [
        ("note" if "stand-in" in kind or "unknown" in kind else "ok", "models", f"{kind} in {count} scenes")
        for kind, count in models.most_common()
    ]
