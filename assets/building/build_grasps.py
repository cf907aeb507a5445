"""Build the robot grasps: `python -m handover_marl.assets.building.build_grasps [--out FILE]`.

The program needs the extra `assets`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from handover_marl.assets.building.robot_grasps import make_robot_grasps
from handover_marl.assets.object_models import find_object_urdf
from handover_marl.assets.shipped import CLASSES_WITHOUT_GRASPS, GRASPS_PATH
from handover_marl.execution.files import write_arrays
from handover_marl.geometry.ycb import CLASS_NAMES


@dataclass(frozen=True)
class Args:
    """Options of the builder of robot grasps.

    Attributes:
        out: Output file (`.npz`).
        only: YCB class names of the objects; all if empty.
        n_grasps: Number of validated grasps per object.
        seed: Random seed; an object's grasps do not depend on other objects.
    """

    out: Path = GRASPS_PATH
    only: tuple[str, ...] = ()
    n_grasps: int = 100
    seed: int = 0


def main(args: Args) -> None:
    """Build the grasps of the chosen objects and write them to one file."""
    names = args.only or tuple(name for name in CLASS_NAMES.values() if name not in CLASSES_WITHOUT_GRASPS)
    grasps = {name: make_robot_grasps(find_object_urdf(name), args.n_grasps, args.seed).grasps for name in names}
    write_arrays(args.out, {name: grasps[name].astype(np.float32) for name in sorted(grasps)})


if __name__ == "__main__":
    main(tyro.cli(Args))
