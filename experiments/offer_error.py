"""How well the place at which an object will be held out is foreseen from its motion so far.

    python experiments/offer_error.py --data-dir DIR

Follows the recorded objects of a split every 50 ms as the receiver `reactive` does, from the moment they are picked
up. Prints the distance to where they end in the recording, by time and by the object's speed, for the prediction,
for the object's present place and for the middle place of all; `--fit` also fits the prediction's constants anew.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import tyro
from rich.progress import track
from scipy.spatial.transform import Rotation

from handover_marl.benchmarking.tables import table
from handover_marl.datasets import open_dataset
from handover_marl.datasets.scene import Scene
from handover_marl.planning.offer_prediction import OfferConfig, OfferPrediction

Array = npt.NDArray[np.float64]

PERIOD = 50  # ms
LIFTED = 0.03  # m
TIMES = (1000, 1250, 1500, 1750, 2000, 2250, 2500)
SPEEDS = (0.0, 0.03, 0.1, 0.2, 0.4, 0.7, 2.0)


@dataclass(frozen=True)
class Args:
    """What to follow.

    Attributes:
        setup: Official setup, s0 to s3.
        split: train or val.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        stride: Take every n-th scene.
        fit: Also fit the constants.
    """

    setup: str = "s0"
    split: str = "train"
    data_dir: str | None = None
    dataset: str = "auto"
    stride: int = 1
    fit: bool = False


@dataclass(frozen=True, eq=False)
class Followed:
    """One moment of one scene: time (ms), and place, velocity, prediction and end of the object, (3,) each."""

    time: int
    place: Array
    velocity: Array
    predicted: Array
    end: Array


def follow(scene: Scene) -> list[Followed]:
    dof = scene.object_dof[:, 0].astype(np.float64)
    poses = np.concatenate([dof[:, :3], Rotation.from_euler("XYZ", dof[:, 3:]).as_quat()], axis=1)
    prediction, found = OfferPrediction(OfferConfig()), []
    for time in range(0, len(poses), PERIOD):
        prediction.see(time / 1000.0, poses[time])
        if prediction.lifted > LIFTED:
            place = prediction.offered()[:3]
            found.append(Followed(time, poses[time, :3], prediction.velocity.copy(), place, poses[-1, :3]))
    return found


def errors(moments: list[Followed]) -> dict[str, Array]:
    """(n,) distances to the end (m) of each way to foresee it."""
    middle = np.mean([moment.end for moment in moments], axis=0)
    return {
        "predicted": np.array([np.linalg.norm(moment.predicted - moment.end) for moment in moments]),
        "present place": np.array([np.linalg.norm(moment.place - moment.end) for moment in moments]),
        "middle place": np.array([np.linalg.norm(middle - moment.end) for moment in moments]),
    }


def rows(moments: list[Followed], groups: list[tuple[str, npt.NDArray[np.bool_]]]) -> str:
    """Median and 90th percentile by group, in cm."""
    found = errors(moments)
    lines = []
    for name, chosen in groups:
        if chosen.any():
            cells = [
                f"{100 * np.median(e[chosen]):.1f} / {100 * np.quantile(e[chosen], 0.9):.1f}" for e in found.values()
            ]
            lines.append([name, str(int(chosen.sum())), *cells])
    return table(["", "n", *found], lines)


def fit(moments: list[Followed]) -> str:
    """`ahead`, `pull` and `place` by least squares, `brisk` as it is."""
    brisk = OfferConfig().brisk
    drawn = np.array([np.tanh(np.linalg.norm(moment.velocity) / brisk) for moment in moments])
    columns = [np.array([moment.velocity for moment in moments]), drawn[:, None] * [moment.place for moment in moments]]
    columns += [drawn[:, None] * axis for axis in np.eye(3)]
    left = np.array([moment.end - moment.place for moment in moments])
    weights = np.linalg.lstsq(np.stack([column.ravel() for column in columns], axis=1), left.ravel(), rcond=None)[0]
    place = weights[2:] / -weights[1]
    return (
        f"ahead {weights[0]:.3f} s, pull {-weights[1]:.3f}, place {np.round(place, 3).tolist()}, at brisk {brisk} m/s"
    )


def main(args: Args) -> None:
    data = open_dataset(args.dataset, args.data_dir)
    scenes = data.split(args.setup, args.split)[:: args.stride]
    moments = [moment for scene in track(scenes, "following") for moment in follow(data.scene(scene))]
    times = np.array([moment.time for moment in moments])
    speeds = np.array([np.linalg.norm(moment.velocity) for moment in moments])
    what = f"{len(scenes)} scenes of {args.setup} {args.split}, {data.name}"
    print(f"Distance to the last place in cm, median / 90 %: {what}")
    print(rows(moments, [(f"{time / 1000:.2f} s", times == time) for time in TIMES]))
    bands = itertools.pairwise(SPEEDS)
    print(rows(moments, [(f"{low:g} to {high:g} m/s", (speeds >= low) & (speeds < high)) for low, high in bands]))
    if args.fit:
        print(fit(moments))


if __name__ == "__main__":
    main(tyro.cli(Args))
