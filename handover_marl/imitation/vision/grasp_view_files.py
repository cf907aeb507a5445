"""Views of many scenes on disk: one file a scene, so that what was interrupted goes on."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataNotFoundError, ResultsError
from handover_marl.files import read_arrays, write_arrays, write_atomically
from handover_marl.imitation.vision.grasp_labels import GraspLabels, LabelConfig
from handover_marl.imitation.vision.grasp_views import GraspViews, ViewConfig, ViewMaker
from handover_marl.imitation.vision.visits import Visits
from handover_marl.planning.arm_in_world import ArmInWorld
from handover_marl.policies.context import context_of
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on

_LARGEST = 1_000_000_000  # bytes
_SOURCE = "source.json"


@dataclass(frozen=True)
class ViewSource:
    """What views are taken of.

    Attributes:
        dataset: dexycb, synthetic, or auto.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        robot: Which Panda looks.
        count: Views of a scene.
        seed: Of everything.
        config: Which views.
        labels: What grasps are worth.
        weights: A grasp network; views are then those that the receiver `vision` comes by with it, in fast physics.
        wait: How long that receiver waits (s).
    """

    dataset: str = "auto"
    data_dir: str | None = None
    robot: str = "panda_camera"
    count: int = 100
    seed: int = 0
    config: ViewConfig = field(default_factory=ViewConfig)
    labels: LabelConfig = field(default_factory=LabelConfig)
    weights: str | None = None
    wait: float = 0.0


class _Scenes:
    """Takes the views of scenes in one process."""

    def __init__(self, source: ViewSource, folder: Path) -> None:
        self._source, self._folder = source, folder
        self._data = open_dataset(source.dataset, source.data_dir, source.robot)
        context = context_of(self._data)
        arm = ArmInWorld.of_panda(context.panda_urdf, context.panda, source.labels.receiver.limit_padding)
        self._maker = ViewMaker(context, arm, GraspLabels(context, source.labels), source.config)
        self._visits = None if source.weights is None else Visits(context, source.weights, source.wait)

    def take(self, number: int) -> None:
        """Write the file of a scene."""
        # What is drawn depends on the scene alone, whoever takes it.
        rng, scene = np.random.default_rng((self._source.seed, number)), self._data.scene(number)
        if self._visits is None:
            views = self._maker.views(scene, self._source.count, rng)
        else:
            views = self._maker.seen(scene, self._visits.places(scene, self._source.count, rng), rng)
        write_arrays(view_file(self._folder, number), views._asdict())


def view_file(folder: Path, scene: int) -> Path:
    """The file of a scene."""
    return folder / f"{scene:03d}.npz"


def take_views(source: ViewSource, scenes: Sequence[int], folder: Path, workers: int, progress: bool = True) -> None:
    """Take the views of some scenes, but for those whose file is there.

    Args:
        source: What of.
        scenes: Numbers of the scenes.
        folder: Where files go; one folder for one source.
        workers: Processes; the files do not depend on it.
        progress: Whether to show a bar on stderr.

    Raises:
        ResultsError: The folder has views of another source, or cannot be written.
        HandoverError: A scene cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_source(source, folder)
    missing = [number for number in scenes if not view_file(folder, number).exists()]
    if missing:
        for _ in worked_on(
            lambda: _Scenes(source, folder).take, missing, "taking views", PoolConfig(workers), progress
        ):
            pass


def _check_source(source: ViewSource, folder: Path) -> None:
    """Views of one source only share a folder; where the data are and how a network's file is called do not matter."""
    told = json.loads(json.dumps(asdict(replace(source, data_dir=None, weights=source.weights and "given"))))
    file = folder / _SOURCE
    if not file.exists():
        write_atomically(file, json.dumps(told, indent=2))
    elif json.loads(file.read_text()) != told:
        raise ResultsError(f"{folder}: it holds views taken with other arguments ({_SOURCE}); choose another folder")


def read_views(scenes: Sequence[int], folder: Path) -> GraspViews:
    """The views of some scenes, in their order.

    Raises:
        DataNotFoundError: There are none.
        DataFormatError: A file is damaged.
    """
    found = [read_arrays(view_file(folder, number), GraspViews._fields, _LARGEST) for number in scenes]
    if not found:
        raise DataNotFoundError(f"{folder}: no views of these {len(scenes)} scenes; take some first")
    return GraspViews(*(np.concatenate([arrays[name] for arrays in found]) for name in GraspViews._fields))
