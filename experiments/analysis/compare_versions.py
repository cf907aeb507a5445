"""Compare the rollouts of two installed versions of the library, bit for bit.

Record the same evaluations with each version, then compare the folders:

    python experiments/analysis/compare_versions.py record --out OLD --command OLD_PROGRAM --data-dir D --old-options
    python experiments/analysis/compare_versions.py record --out NEW --command NEW_PROGRAM --data-dir D
    python experiments/analysis/compare_versions.py compare --old OLD --new NEW

`record` evaluates every receiver with the replayed giver and every giver with `yang2021`, in exact
and in fast physics (two receivers and one giver in MuJoCo too), and records demonstrations in each
observation mode. `compare` reads the stored arrays: actions of every physics step, outcome, release
and contacts, and the recorded observations. Wall-clock times are left out.
"""

import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from handover_marl.datasets import open_dataset

RECEIVERS = (
    "hold",
    "random",
    "yang2021",
    "reactive",
    "vision",
    "gaddpg",
    "omg",
    "omg_hand_aware",
    "omg_unchecked_last",
)
GIVERS = ("cooperative", "hesitant", "hurried", "learned", "noisy", "stop_when_near", "withdrawing")
MUJOCO = (("replay", "yang2021"), ("replay", "reactive"), ("cooperative", "yang2021"))
WITH_CAMERA = ("vision", "gaddpg")
#: Options of 0.7.0 and later for each observation mode.
OBS_MODES = {
    "state+pointcloud": ("--sight points", "--obs-mode state+pointcloud"),
    "full_pointcloud": ("--sight clouds --observe sight", "--obs-mode full_pointcloud"),
    "state+rgbd": ("--sight images", "--obs-mode state+rgbd"),
}
#: Arrays of result files that differ between versions or runs: wall-clock times and what was run.
IGNORED = ("elapsed_time", "fingerprint", "machine", "metadata")
#: New names of arrays that had other names in 0.7.0.
RENAMED = {"fluency_peak_force": "fluency_max_robot_object_force"}


@dataclass(frozen=True)
class Record:
    """Options of the subcommand that evaluates policies with one installed version.

    Attributes:
        out: Folder for the results; finished evaluations in it are kept.
        command: Command line program `handover-marl` of the version.
        data_dir: Data folder in HandoverSim's layout.
        every: Take every n-th scene of s0 train (720 scenes), so that 18 gives 40.
        physics: Physics engines to evaluate in.
        old_options: Whether to use the options of version 0.7.0 for observation modes.
    """

    out: Path
    command: str
    data_dir: str
    every: int = 18
    physics: tuple[str, ...] = ("fast", "exact", "mujoco")
    old_options: bool = False


@dataclass(frozen=True)
class Compare:
    """Options of the subcommand that compares two folders written by `record`.

    Attributes:
        old: Folder with the results of the older version.
        new: Folder with the results of the newer version.
    """

    old: Path
    new: Path


def format_scene_numbers(data_dir: str, every: int) -> str:
    """Return the numbers of every n-th scene of s0 train as text for the option `--scenes`.

    Args:
        data_dir: Data folder in HandoverSim's layout.
        every: Number n.
    """
    scenes = open_dataset("dexycb", data_dir, "panda").list_scenes("s0", "train")
    return ",".join(str(scene) for scene in scenes[::every])


def list_evaluations(physics: str) -> list[tuple[str, str]]:
    """Return the pairs of giver and receiver that are evaluated with a physics engine."""
    if physics == "mujoco":
        return list(MUJOCO)
    return [("replay", receiver) for receiver in RECEIVERS] + [(giver, "yang2021") for giver in GIVERS]


def record(args: Record) -> None:
    """Run the evaluations whose results are missing in the output folder."""
    scenes = format_scene_numbers(args.data_dir, args.every)
    for physics in args.physics:
        for giver, receiver in list_evaluations(physics):
            command = ["pair", "--scenes", scenes, "--giver", giver, "--receiver", receiver, "--physics", physics]
            command += ["--robot", "panda_camera" if receiver in WITH_CAMERA else "panda"]
            _run(args, command, args.out / f"{physics}-{giver}-{receiver}")
    for mode, options in OBS_MODES.items():
        command = ["demonstrate", "--scenes", ",".join(scenes.split(",")[:4]), "--physics", "fast"]
        _run(args, [*command, *options[0 if args.old_options else 1].split()], args.out / f"demonstrations-{mode}")


def _run(args: Record, options: list[str], folder: Path) -> None:
    done = folder / "finished"
    if done.exists():
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    command = [args.command, *options, "--setup", "s0", "--split", "train", "--data-dir", args.data_dir]
    command += ["--workers", "1", "--no-progress", "--out", str(folder)]
    start = time.monotonic()
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    print(f"{folder.name}: exit {result.returncode}, {time.monotonic() - start:.0f} s", flush=True)
    if result.returncode:
        print(result.stderr[-2000:])
    else:
        done.touch()


def compare(args: Compare) -> int:
    """Print differences of stored rollouts and return the number of differing evaluations."""
    n_different = 0
    for old in sorted(path for path in args.old.iterdir() if (path / "finished").exists()):
        new = args.new / old.name
        if not (new / "finished").exists():
            print(f"{old.name}: missing in {args.new}")
            n_different += 1
            continue
        n_files, lines = 0, []
        for path in sorted(old.rglob("*.npz")):
            lines += _find_differences(path, new / path.relative_to(old))
            n_files += 1
        print(f"{old.name}: {'equal' if not lines else f'{len(lines)} differences'} ({n_files} files)")
        print("".join(f"    {line}\n" for line in lines[:5]), end="")
        n_different += bool(lines) or n_files == 0
    print(f"{n_different} evaluations differ")
    return n_different


def _find_differences(old: Path, new: Path) -> list[str]:
    if not new.exists():
        return [f"{old.name} is missing"]
    before, after = _read_arrays(old), _read_arrays(new)
    return [f"{old.name}: {key}" for key in before if key not in after or not _equal(before[key], after[key])]


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a result file or a demonstration file that are compared, by name."""
    with np.load(path, allow_pickle=False) as file:
        return {RENAMED.get(key, key): file[key] for key in file.files if key not in IGNORED}


def _equal(before: np.ndarray, after: np.ndarray) -> bool:
    return before.dtype == after.dtype and before.shape == after.shape and before.tobytes() == after.tobytes()


def main() -> None:
    """Run the subcommand `record` or `compare`."""
    record_args = Annotated[Record, tyro.conf.subcommand("record")]
    compare_args = Annotated[Compare, tyro.conf.subcommand("compare")]
    args = tyro.cli(record_args | compare_args)
    if isinstance(args, Record):
        record(args)
    else:
        raise SystemExit(compare(args) > 0)


if __name__ == "__main__":
    main()
