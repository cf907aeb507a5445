"""List the scenes on which shipped weights were trained, in a YAML file beside each weight file.

    python experiments/analysis/list_training_scenes.py --data-dir DIR --files assets/data/vision_s0.npz

The scenes follow from the training arguments that a weight file contains. DexYCB is needed for setup
s2, whose splits depend on the hand (right or left) that a recording shows.
"""

import ast
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
import yaml

from handover_marl.datasets import Dataset
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.execution.files import write_atomically
from handover_marl.execution.reading import read_arrays
from handover_marl.learning.imitation.gaddpg.data_generation import list_shared_scenes
from handover_marl.learning.training.run_folder import (
    select_held_out_scenes,
    select_training_scenes,
)
from handover_marl.learning.training.scene_arguments import DatasetArgs

#: Suffix of the list of scenes beside a file of weights.
SCENES_SUFFIX = ".scenes.yaml"
_ARGUMENT = re.compile(r"\b(\w+)=('[^']*'|\d+\b|\((?:'[^']*',? ?)+\))")


@dataclass(frozen=True)
class TrainingSceneList:
    """Scenes that a training used, by HandoverSim's numbers.

    Attributes:
        setups: Official setups from whose train splits the training scenes are.
        training: Scenes on which the network was trained.
        held_out: Scenes of the train split on which only errors were measured.
        selection_setup: Official setup of the validation split.
        selection: Scenes of the validation split that were evaluated to choose the network.
    """

    setups: Sequence[str]
    training: Sequence[int]
    held_out: Sequence[int]
    selection_setup: str
    selection: Sequence[int]

    def format(self) -> str:
        """Return the list as YAML."""
        return yaml.safe_dump(
            {name: value if isinstance(value, str) else list(value) for name, value in asdict(self).items()},
            sort_keys=False,
            default_flow_style=None,
            width=110,
        )


def list_scenes_of_training(path: Path, data: Dataset) -> TrainingSceneList:
    """Return the scenes that the training of a shipped file used.

    Args:
        path: File of weights or policy file, written by a script of `experiments/training`.
        data: Dataset of the training.

    Raises:
        Exception: The file does not describe its training; NumPy and json raise errors of many types.
    """
    origin = read_origin(path)
    arguments: dict[str, Any] = {}
    for name, value in _ARGUMENT.findall(origin):
        arguments.setdefault(name, ast.literal_eval(value))
    setups = arguments.get("setups") or (arguments["setup"],)
    selection_setup = arguments.get("val_setup", setups[0])
    selection = select_scenes_evenly(data.list_scenes(selection_setup, "val"), arguments["val_scenes"])
    if "train_gaddpg" in origin:
        return TrainingSceneList(setups, list_shared_scenes(data, setups), (), selection_setup, selection)
    scenes = data.list_scenes(setups[0], "train")[:: arguments.get("stride", 1)]
    return TrainingSceneList(
        setups, select_training_scenes(scenes), select_held_out_scenes(scenes), selection_setup, selection
    )


def read_origin(path: Path) -> str:
    """Return the script and the arguments that made a file of weights or a policy file.

    Raises:
        Exception: The file does not describe its training.
    """
    about = json.loads(str(np.asarray(read_arrays(path, ("about",))["about"])))
    return str(about["made_by"]["made by"] if "made_by" in about else about["spec"]["origin"])


@dataclass(frozen=True)
class Args(DatasetArgs):
    """Arguments of the list of training scenes.

    Attributes:
        files: Files of weights.
    """

    files: tuple[Path, ...] = ()


def main(args: Args) -> None:
    data = args.open_dataset()
    for file in args.files:
        path = file.with_suffix(SCENES_SUFFIX)
        write_atomically(path, list_scenes_of_training(file, data).format())
        print(path)


if __name__ == "__main__":
    main(tyro.cli(Args))
