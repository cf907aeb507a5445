"""Compare generated scenes with DexYCB: Kolmogorov-Smirnov distances over 1,000 scenes each.

    python experiments/analysis/compare_distributions.py --data-dir DIR
    python experiments/analysis/compare_distributions.py --data-dir DIR --datasets generated:n=1000,seed=7

Without a data folder only the figures of the generated scenes are printed. The first 1,000 scenes of
a larger data set are used. The column "aim" has the largest distance that was allowed in the design
of the synthetic scenes.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation
from scipy.stats import ks_2samp
from tabulate import tabulate

from handover_marl.datasets import DATA_DIR_VARIABLE, Dataset, open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.datasets.splits import N_SCENES

Array = npt.NDArray[np.float64]

KEY_STRIDE = 40
KEY_PERIOD = 0.04
PALM_JOINT = ".//joint[@name='joint7']/origin"

QUANTITIES = {
    "handover x (m)": True,
    "handover y (m)": True,
    "handover z (m)": True,
    "start x (m)": True,
    "start y (m)": True,
    "object-to-wrist distance at the handover (m)": True,
    "peak wrist speed (m/s)": True,
    "hand onset (s)": True,
    "duration (s)": True,
    "tilt from start to handover (deg)": False,
    "rotation from start to handover (deg)": False,
    "fingers towards the robot at the handover (-y)": False,
    "left hands": False,
}


@dataclass(frozen=True)
class Args:
    """Options of the comparison of generated scenes with DexYCB.

    Attributes:
        datasets: Names of the data sets that are compared with DexYCB.
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        stride: Use every n-th scene of both data sets.
    """

    datasets: tuple[str, ...] = ("synthetic",)
    data_dir: str | None = None
    stride: int = 1


def main(args: Args) -> None:
    scenes = range(0, N_SCENES, args.stride)
    folder = args.data_dir or os.environ.get(DATA_DIR_VARIABLE)
    real = measure_scenes(open_dataset("dexycb", folder), scenes) if folder else None
    for name in args.datasets:
        print_comparison(name, measure_scenes(open_dataset(name), scenes), real)


def print_comparison(dataset: str, values: Array, real: Array | None) -> None:
    """Print a table of the quartiles of `QUANTITIES` and of the distances to DexYCB.

    Args:
        dataset: Name of the generated data set.
        values: (n, q) values in its scenes.
        real: (m, q) values in the scenes of DexYCB, or None.
    """
    rows = []
    for column, (name, aimed_at) in enumerate(QUANTITIES.items()):
        row = [name, format_quartiles(values[:, column])]
        if real is not None:
            distance = ks_2samp(real[:, column], values[:, column]).statistic
            row += [format_quartiles(real[:, column]), f"{distance:.3f}", "at most 0.100" if aimed_at else "-"]
        rows.append(row)
    header = ["quantity", f"{dataset}: quartiles", "DexYCB: quartiles", "KS distance", "aim"]
    print(f"\n{len(values)} scenes of {dataset}" + ("" if real is None else f", {len(real)} of DexYCB") + ".\n")
    print(tabulate(rows, headers=header[: len(rows[0])], tablefmt="github", disable_numparse=True))


def measure_scenes(dataset: Dataset, scenes: Iterable[int]) -> Array:
    progress = track(list(scenes), dataset.name, console=Console(stderr=True))
    return np.array([measure_scene(dataset.load_scene(scene)) for scene in progress])


def measure_scene(scene: Scene) -> list[float]:
    """Return the values of the compared quantities in one scene, in the order of `QUANTITIES`."""
    assert scene.hand_first is not None
    assert scene.hand_last is not None
    sign = 1.0 if scene.info.side == "left" else -1.0
    target = scene.object_dof[:, 0].astype(np.float64)
    visible = scene.hand_dof[scene.hand_first : scene.hand_last + 1].astype(np.float64)
    hand = Rotation.from_euler("XYZ", visible[:, 3:6])
    wrist = visible[:, :3] + hand.apply(read_palm_position(scene.assets.hand))
    speeds = np.linalg.norm(np.diff(wrist[::KEY_STRIDE], axis=0), axis=1) / KEY_PERIOD
    start, end = (Rotation.from_euler("XYZ", target[frame, 3:]) for frame in (0, -1))
    up = np.array([0.0, 0.0, 1.0])
    tilt = np.arccos(np.clip(start.inv().apply(up) @ end.inv().apply(up), -1.0, 1.0))
    return [
        *target[-1, :3],
        *target[0, :2],
        float(np.linalg.norm(wrist[-1] - target[scene.hand_last, :3])),
        float(speeds.max()),
        scene.hand_first * 0.001,
        (scene.n_frames - 1) * 0.001,
        float(np.degrees(tilt)),
        float(np.degrees((end * start.inv()).magnitude())),
        float(-hand[-1].apply([sign, 0.0, 0.0])[1]),
        float(scene.info.side == "left"),
    ]


def read_palm_position(urdf: Path) -> Array:
    """Return the position (3,) of the palm, at the wrist, in the frame of the hand's base (m).

    Args:
        urdf: URDF file of the hand, from which the position is read.
    """
    from xml.etree import ElementTree

    origin = ElementTree.parse(urdf).find(PALM_JOINT)
    assert origin is not None
    return np.array(str(origin.get("xyz")).split(), dtype=np.float64)


def format_quartiles(values: Array) -> str:
    return " / ".join(f"{value:.3f}" for value in np.quantile(values, (0.25, 0.5, 0.75)))


if __name__ == "__main__":
    main(tyro.cli(Args))
