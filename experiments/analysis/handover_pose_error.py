"""Measure the error of the predicted handover position over time.

    python experiments/analysis/handover_pose_error.py --data-dir DIR

The script predicts the final position of the recorded objects of a split every 50 ms, as the receiver
`reactive` does, from the time at which they are lifted. It prints the distance to the final position
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
    """Motion of handed-over objects at n times of recordings, with predicted final positions.

    Attributes:
        time: (n,) times since the starts of the recordings (ms).
        position: (n, 3) current positions (m).
        velocity: (n, 3) current filtered velocities (m/s).
        predicted: (n, 3) final positions predicted from the motion until then (m).
        end: (n, 3) final positions in the recordings (m).
    """

    time: npt.NDArray[np.int64]
    position: Array
    velocity: Array
    predicted: Array
    end: Array


def predict_along_motion(scene: Scene) -> list[tuple[int, Array, Array, Array, Array]]:
    """Predict the final position of a scene's object every 50 ms after it was lifted.

    Returns:
        Fields of one row of `Observations` for each time.
    """
    dof = scene.object_dof[:, 0].astype(np.float64)
    poses = np.concatenate([dof[:, :3], Rotation.from_euler("XYZ", dof[:, 3:]).as_quat()], axis=1)
    prediction, found = HandoverPosePredictor(HandoverPosePredictorConfig()), []
    for time in range(0, len(poses), PERIOD):
        prediction.update(time / 1000.0, poses[time])
        if prediction.lift_distance > LIFTED:
            predicted = prediction.predict_handover_pose()[:3]
            found.append((time, poses[time, :3], prediction.velocity.copy(), predicted, poses[-1, :3]))
    return found


def make_error_table(observations: Observations, groups: list[tuple[str, npt.NDArray[np.bool_]]]) -> str:
    """Return a table of the median and 90th percentile of prediction errors (cm) by group of times.

    An error is the distance from the object's final position. Beside the prediction the table has
    the object's current position and the mean final position in place of a prediction.

    Args:
        observations: Motion and predicted final positions of objects at n times.
        groups: Name and mask (n,) of every group of times.
    """
    places = {
        "predicted": observations.predicted,
        "present place": observations.position,
        "middle place": observations.end.mean(axis=0),
    }
    found = [np.linalg.norm(place - observations.end, axis=1) for place in places.values()]
    lines = []
    for name, chosen in groups:
        if chosen.any():
            cells = [f"{100 * np.median(e[chosen]):.1f} / {100 * np.quantile(e[chosen], 0.9):.1f}" for e in found]
            lines.append([name, int(chosen.sum()), *cells])
    return format_table(["", "n", *places], lines)


def fit_constants(observations: Observations) -> str:
    """Fit constants of the handover pose predictor by least squares; return them as text.

    Args:
        observations: Motion and true final positions of objects at n times.
    """
    scale = HandoverPosePredictorConfig().attraction_speed
    drawn = np.tanh(np.linalg.norm(observations.velocity, axis=1) / scale)[:, None]
    columns = [observations.velocity, drawn * observations.position, *(drawn * axis for axis in np.eye(3))]
    left = observations.end - observations.position
    weights = np.linalg.lstsq(np.stack([column.ravel() for column in columns], axis=1), left.ravel(), rcond=None)[0]
    place = weights[2:] / -weights[1]
    return (
        f"velocity_horizon {weights[0]:.3f} s, attraction {-weights[1]:.3f}, "
        f"mean_handover_position {np.round(place, 3).tolist()}, at attraction_speed {scale} m/s"
    )


def main(args: Args) -> None:
    args = args.resolve_setup()
    data = args.open_dataset()
    scenes = data.list_scenes(args.setup, args.split)[:: args.stride]
    found = [moment for scene in track(scenes, "following") for moment in predict_along_motion(data.load_scene(scene))]
    observations = Observations(*map(np.array, zip(*found, strict=True)))
    speeds = np.linalg.norm(observations.velocity, axis=1)
    what = f"{len(scenes)} scenes of {args.setup} {args.split}, {data.name}"
    print(f"Distance to the last place in cm, median / 90 %: {what}")
    print(make_error_table(observations, [(f"{time / 1000:.2f} s", observations.time == time) for time in TIMES]))
    bands = itertools.pairwise(SPEEDS)
    print(
        make_error_table(
            observations, [(f"{low:g} to {high:g} m/s", (speeds >= low) & (speeds < high)) for low, high in bands]
        )
    )
    if args.fit:
        print(fit_constants(observations))


if __name__ == "__main__":
    main(tyro.cli(Args))
