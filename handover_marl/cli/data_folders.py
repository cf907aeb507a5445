"""Commands that make and examine data folders."""

import os
from pathlib import Path
from typing import Annotated

import tyro

from handover_marl.cli.run_options import parse_scenes


def run_import(
    dexycb: Annotated[str, tyro.conf.arg(metavar="DIR")],
    mano: Annotated[str, tyro.conf.arg(metavar="DIR")],
    out: Annotated[str, tyro.conf.arg(metavar="DIR")],
    third_party: Annotated[str | None, tyro.conf.arg(metavar="DIR|ARCHIVE")] = None,
    scenes: Annotated[str | None, tyro.conf.arg(metavar="N,N,...")] = None,
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    progress: bool = True,
) -> None:
    """Make HandoverSim's data folder from raw DexYCB, MANO and HandoverSim's third-party archive.

    Args:
        dexycb: The folder that DexYCB's archives were expanded into.
        mano: The folder with MANO_RIGHT.pkl and MANO_LEFT.pkl.
        out: The data folder to make, or to go on with.
        third_party: HandoverSim's assets-3rd-party archive, or the folder that it was unpacked into; without it,
            DexYCB's models, convex parts made of them, the library's grasps and PyBullet's Panda stand in.
        scenes: Only these scenes, e.g. 209,214.
        workers: Processes; default: one a core.
        progress: Show a progress bar on stderr.
    """
    from handover_marl.datasets.importing.import_dexycb import import_dexycb

    chosen = parse_scenes(scenes)
    print(import_dexycb(dexycb, mano, out, third_party=third_party, scenes=chosen, workers=workers, progress=progress))


def run_doctor(
    data_dir: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None,
    progress: bool = True,
) -> int:
    """Look what is installed and what of a data folder is there, and tell what to do about what is not.

    The exit status is 0 if nothing is wrong, 1 if something is. Notes, such as a hand that stands in for MANO's, are
    not wrong.

    Args:
        data_dir: A folder in HandoverSim's layout; default: the one that HANDOVER_MARL_DATA names, if any.
        progress: Show a progress bar on stderr.
    """
    from handover_marl.datasets import DATA_VARIABLE
    from handover_marl.doctor.data_folder import examine
    from handover_marl.doctor.findings import State, findings_text
    from handover_marl.doctor.installation import examine_installation

    findings = list(examine_installation())
    chosen = data_dir or os.environ.get(DATA_VARIABLE)
    if chosen:
        findings += examine(Path(chosen).expanduser(), progress)
    print(findings_text(findings))
    if not chosen:
        print(f"\nNo data folder (--data-dir or {DATA_VARIABLE}): everything runs on the synthetic scenes.")
    return int(any(finding.state is State.FAULT for finding in findings))
