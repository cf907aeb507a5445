"""Measure the error of the predicted handover position over time.

    python experiments/analysis/handover_pose_error.py --data-dir DIR

Predicts the final position of the recorded objects of a split every 50 ms, as the receiver
`reactive` does, from the time at which they are lifted. Prints the distance to the final position
in the recording, by time and by the object's speed, for the prediction, for the current position
and for the mean final position of all scenes. `--fit` also fits the constants of the prediction.
"""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import tyro
from rich.progress import track
from scipy.spatial.transform import Rotation

from handover_marl.datasets.dataset import Scene
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.learning.training.scene_arguments import SetupArgs
from handover_marl.planning.handover_prediction import HandoverPosePredictor, HandoverPosePredictorConfig

Array = npt.NDArray[np.float64]

PERIOD = 50  # ms
LIFTED = 0.03  # m
TIMES = (1000, 1250, 1500, 1750, 2000, 2250, 2500)
SPEEDS = (0.0, 0.03, 0.1, 0.2, 0.4, 0.7, 2.0)


@dataclass(frozen=True)
class Args(SetupArgs):
    """Options of the measurement of errors of the handover pose prediction.

    Attributes:
        split: Split of the setup: train or val.
        stride: Use every n-th scene of the split.
        fit: Whether to fit the constants of the prediction to the recordings too.
    """

    split: str = "train"
    stride: int = 1
    fit: bool = False


class Observations(NamedTuple):
    """Objects at n times of recordings, with the predictions of their final positions.

    Attributes:
        time: (n,) times in the recordings (ms).
        place: (n, 3) current positions (m).
        velocity: (n, 3) current velocities (m/s).
        predicted: (n, 3) predicted final positions (m).
        end: (n, 3) final positions in the recordings (m).
    """

    time: npt.NDArray[np.int64]
    place: Array
    velocity: Array
    predicted: Array
    end: Array


def follow(scene: Scene) -> list[tuple[int, Array, Array, Array, Array]]:
    """Return the fields of `Observations` at each time after the object of a scene is lifted."""
    dof = scene.object_dof[:, 0].astype(np.float64)
    poses = np.concatenate([dof[:, :3], Rotation.from_euler("XYZ", dof[:, 3:]).as_quat()], axis=1)
    prediction, found = HandoverPosePredictor(HandoverPosePredictorConfig()), []
    for time in range(0, len(poses), PERIOD):
        prediction.update(time / 1000.0, poses[time])
        if prediction.lift_distance > LIFTED:
            place = prediction.predict_handover_pose()[:3]
            found.append((time, poses[time, :3], prediction.velocity.copy(), place, poses[-1, :3]))
    return found


def rows(seen: Observations, groups: list[tuple[str, npt.NDArray[np.bool_]]]) -> str:
    """Return a table of the median and 90th percentile of the errors (cm) by group.

    Args:
        seen: Objects and predictions at n times.
        groups: Name and mask (n,) of every group of times.
    """
    places = {"predicted": seen.predicted, "present place": seen.place, "middle place": seen.end.mean(axis=0)}
    found = [np.linalg.norm(place - seen.end, axis=1) for place in places.values()]
    lines = []
    for name, chosen in groups:
        if chosen.any():
            cells = [f"{100 * np.median(e[chosen]):.1f} / {100 * np.quantile(e[chosen], 0.9):.1f}" for e in found]
            lines.append([name, int(chosen.sum()), *cells])
    return format_table(["", "n", *places], lines)


def fit(seen: Observations) -> str:
    """Return the constants of the handover pose predictor fitted by least squares, as text."""
    scale = HandoverPosePredictorConfig().attraction_speed
    drawn = np.tanh(np.linalg.norm(seen.velocity, axis=1) / scale)[:, None]
    columns = [seen.velocity, drawn * seen.place, *(drawn * axis for axis in np.eye(3))]
    left = seen.end - seen.place
    weights = np.linalg.lstsq(np.stack([column.ravel() for column in columns], axis=1), left.ravel(), rcond=None)[0]
    place = weights[2:] / -weights[1]
    return (
        f"velocity_horizon {weights[0]:.3f} s, attraction {-weights[1]:.3f}, "
        f"mean_handover_position {np.round(place, 3).tolist()}, at attraction_speed {scale} m/s"
    )


def main(args: Args) -> None:
    data = args.open_dataset()
    scenes = data.list_scenes(args.setup, args.split)[:: args.stride]
    found = [moment for scene in track(scenes, "following") for moment in follow(data.load_scene(scene))]
    seen = Observations(*map(np.array, zip(*found, strict=True)))
    speeds = np.linalg.norm(seen.velocity, axis=1)
    what = f"{len(scenes)} scenes of {args.setup} {args.split}, {data.name}"
    print(f"Distance to the last place in cm, median / 90 %: {what}")
    print(rows(seen, [(f"{time / 1000:.2f} s", seen.time == time) for time in TIMES]))
    bands = itertools.pairwise(SPEEDS)
    print(rows(seen, [(f"{low:g} to {high:g} m/s", (speeds >= low) & (speeds < high)) for low, high in bands]))
    if args.fit:
        print(fit(seen))


if __name__ == "__main__":
    main(tyro.cli(Args))
