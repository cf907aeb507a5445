"""Measure time and memory of `handover-marl import` for a thousand recordings.

    python experiments/speed/bench_import.py --dexycb DIR --mano DIR --out import.md

By default a thousand recordings with the names and lengths of DexYCB's are made from the longest
recordings of DIR, which may be few: their keyframes are repeated forwards and backwards, and every
keyframe has a hand. With `--as-is` the recordings of DIR are imported unchanged.

The peak memory is sampled over all processes together; shared pages count once.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tyro
import yaml
from measuring import OutputArgs, describe_conditions, read_memory

from handover_marl.datasets.dexycb.raw_files import SequenceFolder, find_sequences, read_sequence_names
from handover_marl.datasets.dexycb.raw_sequence import RawSequence, read_sequence
from handover_marl.evaluation.reports.tables import format_table

#: Number of key poses -> number of DexYCB's recordings that have so many.
LENGTHS = {66: 1, 68: 8, 70: 50, 72: 502, 74: 436, 76: 3}
_SAMPLED = 0.2  # s
_COMMAND = "import sys; from handover_marl.cli import main; sys.exit(main(sys.argv[1:]))"


@dataclass(frozen=True, kw_only=True)
class Args(OutputArgs):
    """Options of the measurement of `handover-marl import`.

    Attributes:
        dexycb: Folder of raw DexYCB recordings.
        mano: Folder with MANO's two model files.
        workers: Number of worker processes of the import.
        as_is: Whether to import the recordings unchanged instead of a thousand made from them.
        longest: Number of the longest recordings, from which the thousand recordings are made.
        work: Folder for about 600 MB of temporary files; default: the system's temporary folder.
        seed: Random seed of the order of the recordings' lengths.
    """

    dexycb: str
    mano: str
    workers: int = 2
    as_is: bool = False
    longest: int = 8
    work: str | None = None
    seed: int = 0


@dataclass
class PeakMemory:
    """Peak memory (MiB) of a process and its descendants.

    Attributes:
        total: Peak of the memory of all processes together; shared pages count once.
        by_process: Peak memory of each process, with shared pages, by process id.
    """

    total: float = 0.0
    by_process: dict[int, float] = field(default_factory=dict)

    def sample(self, root: int) -> None:
        """Update the peaks with the current memory of a process and its descendants.

        Args:
            root: Process id of the ancestor.
        """
        total = 0.0
        for process in _tree(root):
            try:
                peak = read_memory("VmHWM:", f"/proc/{process}/status")
                total += read_memory("Pss:", f"/proc/{process}/smaps_rollup")
            except OSError:  # it has ended
                continue
            self.by_process[process] = max(self.by_process.get(process, 0.0), peak)
        self.total = max(self.total, total)


def main(args: Args) -> None:
    """Make the recordings, import them, and print time and memory of the import."""
    with tempfile.TemporaryDirectory(dir=args.work) as folder:
        work = Path(folder)
        raw = Path(args.dexycb) if args.as_is else work / "dex-ycb"
        if not args.as_is:
            write_repeated_recordings(Path(args.dexycb), raw, args.longest, args.seed)
        args.publish("Import of raw DexYCB", *measure_import(raw, args, work / "out"))


def write_repeated_recordings(source: Path, raw: Path, longest: int, seed: int) -> None:
    """Write a raw data set of a thousand recordings with the names and lengths of DexYCB.

    Args:
        source: Folder of raw DexYCB with at least one recording.
        raw: Folder to write; must not exist.
        longest: Number of the longest recordings of `source`, which are repeated in turn.
        seed: Random seed of the order of the recordings' lengths.
    """
    found = [(sequence, read_sequence(sequence)) for sequence in find_sequences(source).sequences]
    found = sorted(found, key=lambda pair: -len(pair[1].objects))[:longest]
    lengths = [length for length, count in LENGTHS.items() for _ in range(count)]
    random.Random(seed).shuffle(lengths)
    shutil.copytree(source / "calibration", raw / "calibration")
    names = [f"{subject}/{name}" for subject, recordings in read_sequence_names().items() for name in recordings]
    for number, (name, length) in enumerate(zip(names, lengths, strict=True)):
        _write(*found[number % len(found)], raw / name, length)


def _write(sequence: SequenceFolder, recording: RawSequence, folder: Path, length: int) -> None:
    folder.mkdir(parents=True)
    meta = yaml.safe_load((sequence.folder / "meta.yml").read_text())
    (folder / "meta.yml").write_text(yaml.safe_dump({**meta, "num_frames": length}, sort_keys=False))
    shown = np.flatnonzero(recording.hand.any(axis=1))
    frames = shown[_forth_and_back(len(shown), length)]
    np.savez(folder / "pose.npz", pose_y=recording.objects[frames], pose_m=recording.hand[frames][:, None])


def _forth_and_back(n: int, length: int) -> npt.NDArray[np.int64]:
    """Return `length` indices 0, 1, ..., n - 1, n - 2, ..., 0, 1, ..., a triangle wave."""
    phase = np.arange(length) % (2 * (n - 1))
    return np.minimum(phase, 2 * (n - 1) - phase)


def measure_import(raw: Path, args: Args, out: Path) -> tuple[str, str]:
    """Import recordings in a subprocess; return a caption and a table of time and memory.

    Args:
        raw: Folder of raw DexYCB.
        args: Options of the script.
        out: Data folder to create.
    """
    options = {"--dexycb": raw, "--mano": args.mano, "--out": out, "--workers": args.workers}
    command = [sys.executable, "-c", _COMMAND, "import", *(str(part) for option in options.items() for part in option)]
    before, start, peaks = os.times(), time.perf_counter(), PeakMemory()
    with subprocess.Popen([*command, "--no-progress"], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peaks.sample(process.pid)
            time.sleep(_SAMPLED)
    wall, after = time.perf_counter() - start, os.times()
    if process.returncode:
        sys.exit(f"the import ended with {process.returncode}")
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    scenes = len(list((out / "dex-ycb-cache").glob("meta_*.json")))
    size = sum(path.stat().st_size for path in (out / "dex-ycb-cache").iterdir()) / 1e6
    rows: list[list[Any]] = [
        ["scenes", scenes],
        ["time", f"{wall:.0f} s"],
        ["processor time", f"{cpu:.0f} s"],
        ["written", f"{size:.0f} MB, {size / wall:.1f} MB/s"],
        ["peak memory of all processes", f"{peaks.total:.0f} MiB"],
        [
            "peak memory of each process",
            ", ".join(f"{one:.0f} MiB" for one in sorted(peaks.by_process.values(), reverse=True)),
        ],
    ]
    what = f"{raw} as it is" if args.as_is else f"the {args.longest} longest recordings of {args.dexycb}, repeated"
    return f"{describe_conditions()}, {args.workers} workers; {what}.", format_table(["", ""], rows)


def _tree(root: int) -> list[int]:
    try:
        children = Path(f"/proc/{root}/task/{root}/children").read_text().split()
    except OSError:
        return []
    return [root, *(process for child in children for process in _tree(int(child)))]


if __name__ == "__main__":
    main(tyro.cli(Args))
