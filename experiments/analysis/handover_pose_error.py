"""Measure the error of the predicted handover position over time.

    python experiments/analysis/handover_pose_error.py --data-dir DIR

Predicts the final position of the recorded objects of a split every 50 ms, as the receiver
`reactive` does, from the time at which they are lifted. Prints the distance to the final position
in the recording, by time and by the object's speed, for the prediction, for the current position
and for the mean final position of all scenes. `--fit` also fits the constants of the prediction.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import tyro
from rich.progress import track
from scipy.spatial.transform import Rotation

from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.planning.handover_prediction import HandoverPosePredictor, HandoverPosePredictorConfig

Array = npt.NDArray[np.float64]

PERIOD = 50  # ms
LIFTED = 0.03  # m
TIMES = (1000, 1250, 1500, 1750, 2000, 2250, 2500)
SPEEDS = (0.0, 0.03, 0.1, 0.2, 0.4, 0.7, 2.0)


@dataclass(frozen=True)
class Args:
    """Options of the measurement of errors of the handover pose prediction.

    Attributes:
        setup: Official setup, s0 to s3.
        split: Split of the setup: train or val.
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        dataset: Dataset: dexycb, synthetic, or auto.
        stride: Use every n-th scene of the split.
        fit: Whether to fit the constants of the prediction to the recordings too.
    """

    setup: str = "s0"
    split: str = "train"
    data_dir: str | None = None
    dataset: str = "auto"
    stride: int = 1
    fit: bool = False


@dataclass(frozen=True, eq=False)
class Followed:
    """Object at one time of a recording, with the prediction of its final position.

    Attributes:
        time: Time in the recording (ms).
        place: (3,) current position of the object (m).
        velocity: (3,) current velocity of the object (m/s).
        predicted: (3,) predicted final position of the object (m).
        end: (3,) final position of the object in the recording (m).
    """

    time: int
    place: Array
    velocity: Array
    predicted: Array
    end: Array


def follow(scene: Scene) -> list[Followed]:
    dof = scene.object_dof[:, 0].astype(np.float64)
    poses = np.concatenate([dof[:, :3], Rotation.from_euler("XYZ", dof[:, 3:]).as_quat()], axis=1)
    prediction, found = HandoverPosePredictor(HandoverPosePredictorConfig()), []
    for time in range(0, len(poses), PERIOD):
        prediction.update(time / 1000.0, poses[time])
        if prediction.lift_distance > LIFTED:
            place = prediction.predict_handover_pose()[:3]
            found.append(Followed(time, poses[time, :3], prediction.velocity.copy(), place, poses[-1, :3]))
    return found


def errors(moments: list[Followed]) -> dict[str, Array]:
    """Return the distances (n,) (m) from predicted to final object positions, by predictor."""
    middle = np.mean([moment.end for moment in moments], axis=0)
    return {
        "predicted": np.array([np.linalg.norm(moment.predicted - moment.end) for moment in moments]),
        "present place": np.array([np.linalg.norm(moment.place - moment.end) for moment in moments]),
        "middle place": np.array([np.linalg.norm(middle - moment.end) for moment in moments]),
    }


def rows(moments: list[Followed], groups: list[tuple[str, npt.NDArray[np.bool_]]]) -> str:
    """Return a table of the median and 90th percentile of the errors (cm) by group.

    Args:
        moments: Objects and predictions at n times.
        groups: Name and mask (n,) of every group of times.
    """
    found = errors(moments)
    lines = []
    for name, chosen in groups:
        if chosen.any():
            cells = [
                f"{100 * np.median(e[chosen]):.1f} / {100 * np.quantile(e[chosen], 0.9):.1f}" for e in found.values()
            ]
            lines.append([name, str(int(chosen.sum())), *cells])
    return format_table(["", "n", *found], lines)


def fit(moments: list[Followed]) -> str:
    """Return the constants of the handover pose predictor fitted by least squares, as text."""
    scale = HandoverPosePredictorConfig().attraction_speed
    drawn = np.array([np.tanh(np.linalg.norm(moment.velocity) / scale) for moment in moments])
    columns = [np.array([moment.velocity for moment in moments]), drawn[:, None] * [moment.place for moment in moments]]
    columns += [drawn[:, None] * axis for axis in np.eye(3)]
    left = np.array([moment.end - moment.place for moment in moments])
    weights = np.linalg.lstsq(np.stack([column.ravel() for column in columns], axis=1), left.ravel(), rcond=None)[0]
    place = weights[2:] / -weights[1]
    return (
        f"velocity_horizon {weights[0]:.3f} s, attraction {-weights[1]:.3f}, "
        f"mean_handover_position {np.round(place, 3).tolist()}, at attraction_speed {scale} m/s"
    )


def main(args: Args) -> None:
    data = open_dataset(args.dataset, args.data_dir)
    scenes = data.list_scenes(args.setup, args.split)[:: args.stride]
    moments = [moment for scene in track(scenes, "following") for moment in follow(data.load_scene(scene))]
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
