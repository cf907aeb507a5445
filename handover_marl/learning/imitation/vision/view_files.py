"""Files of rendered views, one per scene, so that interrupted generation can be resumed."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from handover_marl.datasets import open_dataset
from handover_marl.errors import DataFormatError, DataNotFoundError, ResultsError
from handover_marl.execution.files import shorten_text, write_arrays, write_atomically
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.reading import read_arrays, read_plain_file
from handover_marl.execution.tasks import map_with_progress
from handover_marl.learning.imitation.vision.dagger import DaggerCollector
from handover_marl.learning.imitation.vision.grasp_labels import GraspLabelConfig, GraspLabeller
from handover_marl.learning.imitation.vision.views import GraspViewConfig, GraspViews, ViewRenderer
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.policies.policy import make_policy_context

_MAX_BYTES = 1_000_000_000
_SOURCE = "source.json"


@dataclass(frozen=True)
class ViewDatasetConfig:
    """Configuration of the rendered views of a set of scenes.

    Attributes:
        dataset: Dataset: dexycb, synthetic, or auto.
        data_dir: Folder in HandoverSim's layout; default: environment variable HANDOVER_MARL_DATA.
        robot: Robot model that carries the camera: panda or panda_camera.
        count: Number of views per scene.
        seed: Seed of all random numbers.
        config: Distribution and size of the views.
        labels: Configuration of the qualities of grasps.
        weights: File of a grasp network; if set, views are those that the receiver `vision` meets
            with it in fast physics.
        wait: Time that the receiver `vision` waits (s).
    """

    dataset: str = "auto"
    data_dir: str | None = None
    robot: str = "panda_camera"
    count: int = 100
    seed: int = 0
    config: GraspViewConfig = field(default_factory=GraspViewConfig)
    labels: GraspLabelConfig = field(default_factory=GraspLabelConfig)
    weights: str | None = None
    wait: float = 0.0


class _ViewWorker:
    """Generator of rendered views in one process."""

    def __init__(self, config: ViewDatasetConfig, folder: Path) -> None:
        self._config, self._folder = config, folder
        self._data = open_dataset(config.dataset, config.data_dir, config.robot)
        context = make_policy_context(self._data)
        arm = ArmInWorld.for_panda(context.panda_urdf, context.panda, config.labels.receiver.limit_padding)
        self._renderer = ViewRenderer(context, arm, GraspLabeller(context, config.labels), config.config)
        self._collector = None if config.weights is None else DaggerCollector(context, config.weights, config.wait)

    def write_scene(self, number: int) -> None:
        """Write the file of a scene."""
        # Seeded by the scene, so that files do not depend on the number of processes.
        rng, scene = np.random.default_rng((self._config.seed, number)), self._data.load_scene(number)
        if self._collector is None:
            views = self._renderer.render_random(scene, self._config.count, rng)
        else:
            poses = self._collector.collect_poses(scene, self._config.count, rng)
            views = self._renderer.render_poses(scene, poses, rng)
        write_arrays(get_view_path(self._folder, number), views._asdict())


def get_view_path(folder: Path, scene: int) -> Path:
    """Return the path of the file with the views of a scene."""
    return folder / f"{scene:03d}.npz"


def generate_views(
    config: ViewDatasetConfig, scenes: Sequence[int], folder: Path, workers: int, progress: bool = True
) -> None:
    """Render the views of scenes that have no file yet, and write one file per scene.

    Args:
        config: Configuration of the views.
        scenes: Numbers of the scenes.
        folder: Folder of the files, for one configuration only.
        workers: Number of processes; the files do not depend on it.
        progress: Whether to show a progress bar on stderr.

    Raises:
        ResultsError: The folder contains views of another configuration, or cannot be written.
        HandoverError: A scene cannot be read.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _check_config(config, folder)
    missing = [number for number in scenes if not get_view_path(folder, number).exists()]
    if missing:
        for _ in map_with_progress(
            lambda: _ViewWorker(config, folder).write_scene, missing, "rendering views", PoolConfig(workers), progress
        ):
            pass


def read_views(scenes: Sequence[int], folder: Path) -> GraspViews:
    """Read the rendered views of scenes, concatenated in the order of the scenes.

    Raises:
        DataNotFoundError: A file does not exist, or `scenes` is empty.
        DataFormatError: A file is damaged.
    """
    if not scenes:
        raise DataNotFoundError(f"{folder}: no views without scenes; pass at least one scene")
    parts = [_read_scene(get_view_path(folder, number)) for number in scenes]
    return GraspViews(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _read_scene(path: Path) -> GraspViews:
    if not path.exists():
        raise DataNotFoundError(f"{path}: no views of this scene; generate them first")
    try:
        arrays = read_arrays(path, GraspViews._fields, _MAX_BYTES)
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise DataFormatError(f"{path}: not a file of views ({shorten_text(error)}); remove it") from error
    return GraspViews(*arrays.values())


def _check_config(config: ViewDatasetConfig, folder: Path) -> None:
    """Check that the folder is empty or has the same configuration, apart from paths."""
    expected = json.loads(json.dumps(asdict(replace(config, data_dir=None, weights=config.weights and "given"))))
    file = folder / _SOURCE
    if not file.exists():
        write_atomically(file, json.dumps(expected, indent=2))
    elif _read_config(file) != expected:
        raise ResultsError(f"{folder} has views of another configuration ({_SOURCE}); choose another folder")


def _read_config(file: Path) -> Any:
    try:
        return json.loads(read_plain_file(file))
    except (OSError, ValueError, RecursionError) as error:
        raise ResultsError(f"{file}: not the configuration of views ({shorten_text(error)}); remove it") from error
