"""Human grasps of the library's objects.

For every object, side and subject, grasps are drawn all over the object, and a varied set of them is selected whose
wrist distances are distributed as in DexYCB.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.progress import track
from scipy.spatial.transform import Rotation

from handover_marl.assets.anthropometry import SUBJECT_SIZES, HandSize
from handover_marl.assets.hand_model import SIDES, Side
from handover_marl.assets.human_grasps import (
    ANGLE_STEP,
    GRASPED_OBJECTS,
    GRASPS_FILE,
    LEVELS,
    WRIST_DISTANCE_QUANTILES,
    HumanGrasps,
)
from handover_marl.assets.shipped import find_object_urdf
from handover_marl.datasets.generated.human_grasps import HumanGraspConfig, draw_human_grasps
from handover_marl.datasets.generated.shapes import Solid, read_solid
from handover_marl.datasets.synthetic.random_stream import RandomStream
from handover_marl.execution.files import write_arrays

Array = npt.NDArray[np.float64]

_SEARCH = HumanGraspConfig(n_pairs=6000, n_closed=200, n_grasps=250, n_rounds=20)
_N_GRASPS = 20  # of each object, side and subject
_AXES = (1.0,) * 6  # A hand may come from any side.


def build_human_grasps(out: Path = GRASPS_FILE) -> None:
    """Build all grasps and write them, indexed by object, side, subject and grasp.

    Args:
        out: Output file (`.npz`).
    """
    found = []
    for number, name in enumerate(track(GRASPED_OBJECTS, description="human grasps")):
        solid = read_solid(find_object_urdf(name))
        found.append(
            [
                [
                    make_human_grasps(name, solid, size, side, number, SIDES.index(side), person)
                    for person, size in enumerate(SUBJECT_SIZES)
                ]
                for side in SIDES
            ]
        )
    arrays = {
        key: np.array([[[one[key] for one in side] for side in item] for item in found]) for key in found[0][0][0]
    }
    write_arrays(out, {"object_names": np.array(GRASPED_OBJECTS), **arrays})


def make_human_grasps(
    name: str, solid: Solid, size: HandSize, side: Side, *seed: int
) -> dict[str, npt.NDArray[np.generic]]:
    """Return 20 grasps of a YCB class by one hand, as arrays of the output file."""
    random = RandomStream(*seed)
    grasps = draw_human_grasps(random, solid, _AXES, size, side, _SEARCH)
    if grasps is None:
        raise ValueError(f"{name}: no grasp found; use another seed")
    rows = select_grasps(random, grasps, name, _N_GRASPS)
    pose = grasps.object_from_base[rows]
    pose[:, 3:] *= np.where(pose[:, 6:] < 0.0, -1.0, 1.0)
    return {
        "object_from_base": pose.astype(np.float32),
        "finger_angles": np.round(grasps.finger_angles[rows] / ANGLE_STEP).astype(np.int16),
        "open_angles": np.round(grasps.open_angles[rows] / ANGLE_STEP).astype(np.int16),
        "wrist_distance": grasps.wrist_distance[rows].astype(np.float32),
        "touching": grasps.touching[rows],
        "overlap": grasps.overlap[rows].astype(np.float32),
    }


def select_grasps(random: RandomStream, grasps: HumanGrasps, name: str, count: int) -> npt.NDArray[np.intp]:
    """Return the indices of varied and firm grasps, sorted by wrist distance.

    The k-th grasp is the best grasp for a wrist distance that is drawn between the quantiles k/count and (k+1)/count
    of DexYCB.
    """
    shares = (np.arange(count) + random.uniforms(count)) / count
    goals = np.interp(shares, LEVELS, WRIST_DISTANCE_QUANTILES[name])
    costs = 100.0 * grasps.overlap - 0.35 * grasps.touching.sum(axis=1)
    positions, rotations = grasps.object_from_base[:, :3], Rotation.from_quat(grasps.object_from_base[:, 3:])
    chosen: list[int] = []
    for goal in goals[np.argsort(random.uniforms(count))]:
        best = int(np.argmin(costs + ((grasps.wrist_distance - goal) / 0.004) ** 2))
        chosen.append(best)
        # Grasps within 4 cm and 40 degrees are similar.
        apart = np.linalg.norm(positions - positions[best], axis=1) / 0.04
        turned = (rotations[best].inv() * rotations).magnitude() / 0.7
        costs += 3.0 * np.exp(-(apart**2) - turned**2)
        costs[best] += 1e6
    return np.array(chosen)[np.argsort(grasps.wrist_distance[chosen])]
