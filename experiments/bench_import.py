"""How long `handover-marl import` takes for the thousand recordings of DexYCB, and how much memory.

    python experiments/bench_import.py --dexycb DIR --mano DIR --out import.md

By default the recordings are invented ones of the real number, names and lengths: the longest recordings of DIR, which
may be few, are played forth and back until they have as many key poses as DexYCB's, with a hand in every one. With
`--as-is` DIR is imported as it is.

Memory is that of all processes together, sampled; pages that processes share count once.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tyro
import yaml

from handover_marl.benchmarking.machine import describe_machine
from handover_marl.benchmarking.tables import table
from handover_marl.datasets.importing.raw_layout import SequenceFolder, find_sequences
from handover_marl.datasets.importing.raw_sequence import RawSequence, read_sequence
from handover_marl.datasets.importing.sequence_names import SEQUENCE_NAMES
from handover_marl.files import write_atomically

#: Number of key poses -> number of DexYCB's recordings that have so many.
LENGTHS = {66: 1, 68: 8, 70: 50, 72: 502, 74: 436, 76: 3}
_SAMPLED = 0.2  # s
_COMMAND = "import sys; from handover_marl.cli import main; sys.exit(main(sys.argv[1:]))"


@dataclass(frozen=True)
class Args:
    """What to measure.

    Attributes:
        dexycb: A raw DexYCB folder.
        mano: The folder with MANO's two files.
        workers: Processes that import.
        as_is: Import the folder itself.
        longest: How many of its recordings are repeated otherwise.
        work: Where to write some 600 MB, removed afterwards; default: the folder for temporary files.
        seed: Of the lengths' order.
        out: Markdown file to write; default: only printed.
    """

    dexycb: str
    mano: str
    workers: int = 2
    as_is: bool = False
    longest: int = 8
    work: str | None = None
    seed: int = 0
    out: str | None = None


@dataclass
class Peaks:
    """The most memory that was seen, MB.

    Attributes:
        together: Of all processes at one time, shared pages once.
        apart: Of each process, shared pages included, by process id.
    """

    together: float = 0.0
    apart: dict[int, float] = field(default_factory=dict)

    def sample(self, root: int) -> None:
        """Look at a process and all below it."""
        total = 0.0
        for process in _tree(root):
            try:
                state = Path(f"/proc/{process}/status").read_text()
                shared = Path(f"/proc/{process}/smaps_rollup").read_text()
            except OSError:  # it has ended
                continue
            total += _kilobytes(shared, "Pss:") / 1000
            self.apart[process] = max(self.apart.get(process, 0.0), _kilobytes(state, "VmHWM:") / 1000)
        self.together = max(self.together, total)


def main(args: Args) -> None:
    """Build the recordings, import them, and tell what that took."""
    with tempfile.TemporaryDirectory(dir=args.work) as folder:
        work = Path(folder)
        raw = Path(args.dexycb) if args.as_is else work / "dex-ycb"
        if not args.as_is:
            repeat(Path(args.dexycb), raw, args.longest, args.seed)
        text = measured(raw, args, work / "out")
    print(text)
    if args.out is not None:
        write_atomically(Path(args.out), text)


def repeat(source: Path, raw: Path, longest: int, seed: int) -> None:
    """A raw DexYCB of a thousand recordings with DexYCB's names and lengths.

    Args:
        source: A raw folder with at least one recording.
        raw: Where to write; it does not exist.
        longest: How many of its recordings take turns, the longest ones.
        seed: Of the lengths' order.
    """
    found = [(sequence, read_sequence(sequence)) for sequence in find_sequences(source).sequences]
    found = sorted(found, key=lambda pair: -len(pair[1].objects))[:longest]
    lengths = [length for length, count in LENGTHS.items() for _ in range(count)]
    random.Random(seed).shuffle(lengths)
    shutil.copytree(source / "calibration", raw / "calibration")
    names = [f"{subject}/{name}" for subject, recordings in SEQUENCE_NAMES.items() for name in recordings]
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
    """Indices 0, 1, ..., n - 1, n - 2, ..., 0, 1, ... (length,)."""
    phase = np.arange(length) % (2 * (n - 1))
    return np.minimum(phase, 2 * (n - 1) - phase)


def measured(raw: Path, args: Args, out: Path) -> str:
    """Import in a process of its own; a table of what it took."""
    options = {"--dexycb": raw, "--mano": args.mano, "--out": out, "--workers": args.workers}
    command = [sys.executable, "-c", _COMMAND, "import", *(str(part) for option in options.items() for part in option)]
    before, start, peaks = os.times(), time.perf_counter(), Peaks()
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
        ["peak memory of all processes", f"{peaks.together:.0f} MB"],
        [
            "peak memory of each process",
            ", ".join(f"{one:.0f} MB" for one in sorted(peaks.apart.values(), reverse=True)),
        ],
    ]
    what = f"{raw} as it is" if args.as_is else f"the {args.longest} longest recordings of {args.dexycb}, repeated"
    return (
        f"# Import of raw DexYCB\n\n{date.today()}, {describe_machine()}, {args.workers} workers; {what}.\n\n"
        f"{table(['', ''], rows)}\n"
    )


def _tree(root: int) -> list[int]:
    try:
        children = Path(f"/proc/{root}/task/{root}/children").read_text().split()
    except OSError:
        return []
    return [root, *(process for child in children for process in _tree(int(child)))]


def _kilobytes(text: str, name: str) -> float:
    return next((float(line.split()[1]) for line in text.splitlines() if line.startswith(name)), 0.0)


if __name__ == "__main__":
    main(tyro.cli(Args))
