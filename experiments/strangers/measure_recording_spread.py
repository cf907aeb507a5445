"""Measure how much recordings of the same object differ in handover pose and pace.

    python experiments/strangers/measure_recording_spread.py --data-dir DIR --out givers/recording_spread.json

The giver `recording_spread` draws its deviations from this table. For every object of a train split, recordings are
grouped by the hand that gives it, because the poses of right and left hands differ. The table has the standard
deviation, over the recordings of an object, of the deviation from the group's mean: of the wrist's last position, of
the rotation of the hand's last orientation, and of the logarithm of the duration of the motion from pick-up to the
handover pose.
"""

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from scipy.spatial.transform import Rotation

from handover_marl.config import TIME_STEP
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.giver_motion import find_pick_up_frame, find_wrist_in_base
from handover_marl.episode.wrist_offset import compute_wrist_positions
from handover_marl.execution.files import write_atomically
from handover_marl.geometry.poses import quaternions_from_euler

#: Distance of the wrist from its last position below which it has arrived (m).
ARRIVAL_TOLERANCE = 0.02
#: Key of the statistics over the recordings of all objects.
ALL_OBJECTS = "all"


@dataclass(frozen=True, eq=False)
class RecordedHandover:
    """Handover pose and duration of one recording.

    Attributes:
        position: (3,) last position of the wrist, world frame (m).
        orientation: Last orientation of the hand, world frame.
        duration: Time from pick-up to arrival (s).
    """

    position: npt.NDArray[np.float64]
    orientation: Rotation
    duration: float


@dataclass(frozen=True)
class Args:
    """Options of the command line.

    Attributes:
        out: Output file (.json).
        dataset: Data set of the recordings.
        data_dir: Data folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        setup: Setup of the data set.
        split: Split of the setup.
    """

    out: Path
    dataset: str = "dexycb"
    data_dir: str | None = None
    setup: str = "s0"
    split: str = "train"


def measure_handover(scene: Scene) -> RecordedHandover | None:
    """Measure handover pose and duration of a recording; None if the object is not picked up or no hand is visible."""
    pick_up = find_pick_up_frame(scene)
    if pick_up is None or scene.hand_last is None:
        return None
    hand = scene.hand_dof[: scene.hand_last + 1]
    positions = compute_wrist_positions(hand, find_wrist_in_base(scene))
    distances = np.linalg.norm(positions - positions[-1], axis=1)
    moving = np.flatnonzero(distances > ARRIVAL_TOLERANCE)
    steps = int(moving[-1]) + 1 - pick_up if len(moving) else 0
    if steps <= 0:
        return None
    return RecordedHandover(
        positions[-1], Rotation.from_quat(quaternions_from_euler(hand[-1:, 3:6])[0]), steps * TIME_STEP
    )


def compute_residuals(group: Sequence[RecordedHandover]) -> npt.NDArray[np.float64]:
    """Compute the deviations (n, 7) from a group's mean: position (m), rotation vector (rad), logarithm of duration."""
    positions = np.array([each.position for each in group])
    orientations = Rotation.concatenate([each.orientation for each in group])
    durations = np.log([each.duration for each in group])
    turns = (orientations * orientations.mean().inv()).as_rotvec()
    return np.column_stack([positions - positions.mean(axis=0), turns, durations - durations.mean()])


def format_spread(residuals: Sequence[npt.NDArray[np.float64]]) -> dict[str, object]:
    """Format the standard deviations of groups of residuals; each group costs a degree of freedom."""
    rows = np.concatenate(residuals)
    deviations = np.sqrt((rows**2).sum(axis=0) / max(len(rows) - len(residuals), 1)).round(4).tolist()
    return {"displacement": deviations[:3], "rotation": deviations[3:6], "log_pace": deviations[6], "n": len(rows)}


def measure_spread(dataset: Dataset, scenes: Sequence[int]) -> dict[str, dict[str, object]]:
    """Measure the spread of handovers for every object, and over all objects."""
    groups: defaultdict[tuple[str, str], list[RecordedHandover]] = defaultdict(list)
    for number in scenes:
        scene = dataset.load_scene(number)
        handover = measure_handover(scene)
        if handover is not None:
            groups[scene.info.target_name, scene.info.side].append(handover)
    residuals: defaultdict[str, list[npt.NDArray[np.float64]]] = defaultdict(list)
    for (name, _), group in sorted(groups.items()):
        if len(group) > 1:
            residuals[name].append(compute_residuals(group))
    everything = [each for parts in residuals.values() for each in parts]
    return {ALL_OBJECTS: format_spread(everything), **{name: format_spread(each) for name, each in residuals.items()}}


def main(args: Args) -> None:
    """Measure the spread and write the table."""
    dataset = open_dataset(args.dataset, args.data_dir)
    scenes = dataset.list_scenes(args.setup, args.split)
    content = {
        "source": f"{args.dataset} {args.setup} {args.split}, {len(scenes)} recordings",
        "description": "Standard deviations between recordings of the same object, given by the same hand (right or "
        "left): last wrist position per world axis (m), rotation vector of the last hand orientation (rad), logarithm "
        f"of the duration from pick-up to {100 * ARRIVAL_TOLERANCE:g} cm from the last position. n: recordings.",
        "objects": measure_spread(dataset, scenes),
    }
    write_atomically(args.out, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
