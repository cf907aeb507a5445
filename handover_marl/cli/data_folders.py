"""Commands that create and check data folders."""

import os
from typing import Annotated

import tyro

from handover_marl.cli.options import SceneNumbers
from handover_marl.cli.streams import print_result
from handover_marl.execution.options import check_path


def run_import(
    dexycb: Annotated[str, tyro.conf.arg(metavar="DIR")],
    mano: Annotated[str, tyro.conf.arg(metavar="DIR")],
    out: Annotated[str, tyro.conf.arg(metavar="DIR")],
    third_party: Annotated[str | None, tyro.conf.arg(metavar="DIR|ARCHIVE")] = None,
    scenes: SceneNumbers = None,
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    progress: bool = True,
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
        workers: Number of worker processes; default: one per core.
        progress: Show a progress bar on stderr.
    """
    from handover_marl.datasets.dexycb.importer import import_dexycb

    report = import_dexycb(
        dexycb, mano, out, third_party=third_party, scenes=scenes, workers=workers, progress=progress
    )
    print_result(f"{report}\n\nData folder: {report.out}")
    return int(not report.scenes)


def run_doctor(data_dir: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None, progress: bool = True) -> int:
    """Check the installation and a data folder, with advice for each problem.

    The exit status is 1 if there is a fault, else 0. Notes, such as substitutes for MANO's hands, are
    not faults.

    Args:
        data_dir: Data folder in HandoverSim's layout; default: the environment variable
            HANDOVER_MARL_DATA, if set.
        progress: Show a progress bar on stderr.
    """
    from handover_marl.cli.installation import examine_installation
    from handover_marl.datasets import DATA_DIR_VARIABLE
    from handover_marl.datasets.folder_check import Severity, examine_data_folder, format_findings

    findings = list(examine_installation())
    chosen = os.environ.get(DATA_DIR_VARIABLE) if data_dir is None else str(check_path("data_dir", data_dir))
    if chosen:
        findings += examine_data_folder(check_path("data_dir", chosen), progress)
    print_result(format_findings(findings))
    if chosen:
        print_result(f"\nData folder: {chosen}")
    else:
        print_result(f"\nNo data folder (--data-dir or {DATA_DIR_VARIABLE}): synthetic scenes are used.")
    return int(any(finding.severity is Severity.FAULT for finding in findings))
