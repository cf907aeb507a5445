"""The expert's plans on disk: made once, in several processes, and gone on with where a run was stopped."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl.errors import ResultsError
from handover_marl.files import write_arrays
from handover_marl.imitation.gaddpg.expert import ExpertPlan
from handover_marl.imitation.gaddpg.workshop import Workshop, WorkshopConfig, made
from handover_marl.pools.pool_config import PoolConfig

#: So many plans are a file, and a task for a worker.
CHUNK = 16

Plans = dict[int, ExpertPlan]


def make_plans(
    folder: Path, config: WorkshopConfig, count: int, pool: PoolConfig, done: Callable[[int], None] = lambda n: None
) -> Plans:
    """Plans of the first so many situations; those without one are left out.

    Args:
        folder: Where plans are kept.
        config: Of what.
        count: Situations.
        pool: Who plans.
        done: Told how many situations more are finished.

    Raises:
        ResultsError: A file is damaged or cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mark = hashlib.sha256(repr((config.scenes, config.seed, config.situations, config.prices, config.expert)).encode())
    paths = {first: folder / f"plans-{mark.hexdigest()[:12]}-{first:06d}.npz" for first in range(0, count, CHUNK)}
    missing = [first for first, path in paths.items() if not path.exists()]
    done(count - CHUNK * len(missing))
    for number, plans in made(_chunk, config, missing, pool):
        _write(paths[missing[number]], plans)
        done(CHUNK)
    found: Plans = {}
    for path in paths.values():
        found |= _read(path)
    return {number: plan for number, plan in found.items() if number < count}


def _chunk(workshop: Workshop, first: int) -> Plans:
    plans = {number: workshop.plan(number) for number in range(first, first + CHUNK)}
    return {number: plan for number, plan in plans.items() if plan is not None}


def _write(path: Path, plans: Plans) -> None:
    arrays: dict[str, npt.NDArray[Any]] = {"numbers": np.array(sorted(plans), dtype=np.int64)}
    for number, plan in plans.items():
        arrays |= {f"goals_{number}": plan.goals, f"prices_{number}": plan.prices, f"path_{number}": plan.path}
    write_arrays(path, arrays)


def _read(path: Path) -> Plans:
    try:
        with np.load(path, allow_pickle=False) as content:
            return {
                number: ExpertPlan(*(content[f"{part}_{number}"] for part in ("goals", "prices", "path")))
                for number in content["numbers"].tolist()
            }
    except Exception as error:  # what NumPy and zipfile raise on damaged bytes has no end
        raise ResultsError(f"{path}: no plans ({type(error).__name__}); remove it to make them anew") from error
