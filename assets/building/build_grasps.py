"""Make the grasps of the procedural objects: `python -m handover_marl.assets.building.build_grasps [--out FILE]`.

Opposite surface points are drawn, the hand's way to them is checked for collisions, and of what is left the most
different ones are tried in simulation until enough have held the object through a shake. Needs the extra `assets`.
"""

import io
import itertools
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from handover_marl.assets.building.grasp_sampling import ConvexSolid, sample_candidates, spread_order
from handover_marl.assets.building.object_meshes import load_collision_parts
from handover_marl.assets.object_models import object_urdf
from handover_marl.assets.shipped_grasps import GRASPS_PATH, UNGRASPABLE
from handover_marl.errors import HandoverError
from handover_marl.files import write_atomically
from handover_marl.models.ycb import CLASS_NAMES
from handover_marl.sim.bullet.bullet_trial import BulletTrial

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Args:
    """What to build.

    Attributes:
        out: The `.npz` file to write.
        only: Class names to build, the file's other ones stay; all graspable ones if empty.
        n_grasps: Proven grasps per object.
        n_free: Collision-free candidates to choose them from.
        n_drawn: Candidates drawn at a time, collisions or not.
        n_draws: Most draws; an object with few places to grasp gives fewer candidates than `n_free`.
        seed: Seed of everything random; an object's grasps do not depend on the other objects.
    """

    out: Path = GRASPS_PATH
    only: tuple[str, ...] = ()
    n_grasps: int = 100
    n_free: int = 600
    n_drawn: int = 8_000
    n_draws: int = 20
    seed: int = 0


@dataclass(frozen=True)
class ObjectGrasps:
    """Proven grasps `object_from_gripper` (n, 4, 4) and how many trials they took."""

    transforms: Array
    n_trials: int


def build_object_grasps(name: str, args: Args, on_proven: Callable[[], None] = lambda: None) -> ObjectGrasps:
    """Proven grasps of one object.

    Raises:
        HandoverError: Too few grasps held.
    """
    trial = BulletTrial(object_urdf(name))
    try:
        free = _free_candidates(name, trial, args)
        proven: list[Array] = []
        for n_trials, index in enumerate(spread_order(free), start=1):
            if trial.holds(free[index]):
                proven.append(free[index])
                on_proven()
            if len(proven) == args.n_grasps:
                return ObjectGrasps(np.stack(proven), n_trials)
    finally:
        trial.close()
    raise HandoverError(f"{name}: {len(free)} places to grasp, and only {len(proven)} of {args.n_grasps} held")


def _free_candidates(name: str, trial: BulletTrial, args: Args) -> Array:
    """Up to `args.n_free` grasps (k, 4, 4), rounded to float32 as they are stored, that the hand can reach."""
    solid = ConvexSolid(load_collision_parts(name))
    free: list[Array] = []
    for draw in range(args.n_draws):
        candidates = sample_candidates(solid, args.n_drawn, zlib.crc32(f"{name} {args.seed} {draw}".encode()))
        stored = candidates.astype(np.float32).astype(np.float64)
        free += itertools.islice(filter(trial.is_free, stored), args.n_free - len(free))
        if len(free) == args.n_free:
            break
    return np.array(free).reshape(-1, 4, 4)


def _known(path: Path) -> dict[str, Array]:
    if not path.is_file():
        return {}
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _write(path: Path, grasps: dict[str, Array]) -> None:
    stream = io.BytesIO()
    arrays: dict[str, Any] = {name: array.astype(np.float32) for name, array in sorted(grasps.items())}
    np.savez_compressed(stream, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, stream.getvalue())


def main(args: Args) -> None:
    """Build the chosen objects' grasps into one file."""
    names = args.only or tuple(name for name in CLASS_NAMES.values() if name not in UNGRASPABLE)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    grasps = _known(args.out) if args.only else {}
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("grasps", total=len(names) * args.n_grasps)
        for name in names:
            progress.update(task, description=f"{name:22}")
            result = build_object_grasps(name, args, on_proven=lambda: progress.advance(task))
            grasps[name] = result.transforms
            progress.console.print(f"{name:22} {args.n_grasps} proven in {result.n_trials} trials")
    _write(args.out, grasps)


if __name__ == "__main__":
    main(tyro.cli(Args))
