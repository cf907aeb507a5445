"""Files of rendered views, one per scene, so that interrupted generation can be resumed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.datasets import open_dataset
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.callbacks import EpisodeCallback, PolicyDecision
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.learning.imitation.samples import generate_samples, join_samples
from handover_marl.learning.imitation.vision.grasp_labels import GraspLabelConfig, GraspLabeller
from handover_marl.learning.imitation.vision.views import GraspViewConfig, GraspViews, ViewRenderer
from handover_marl.planning.arm_control import ArmInWorld
from handover_marl.policies.policy import PolicyContext, make_policy_context
from handover_marl.receivers.reactive.controller import LIMIT_PADDING
from handover_marl.receivers.vision.receiver import VisionReceiver

Array = npt.NDArray[np.float64]

# Commanded finger position below which the gripper is closing (m).
_OPEN = 0.03


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
    """

    dataset: str = "auto"
    data_dir: str | None = None
    robot: str = "panda_camera"
    count: int = 100
    seed: int = 0
    config: GraspViewConfig = field(default_factory=GraspViewConfig)
    labels: GraspLabelConfig = field(default_factory=GraspLabelConfig)
    weights: str | None = None


class DaggerCollector:
    """Collector of arm joint positions in rollouts of the receiver `vision` (DAgger; Ross et al., AISTATS 2011).

    Rollouts run in fast physics; the giver replays the recording.

    Args:
        context: Robot and task.
        weights: Weight file of the receiver's grasp network.

    Raises:
        HandoverError: The receiver cannot be created.
    """

    def __init__(self, context: PolicyContext, weights: str) -> None:
        self._receiver = VisionReceiver(context, weights=weights)
        self._episode = Episode("fast", context.config)

    def collect_poses(self, scene: Scene, count: int, rng: np.random.Generator) -> list[tuple[int, Array]]:
        """Return the time and the arm joints at up to `count` random decisions in a rollout.

        Decisions after the gripper has started to close are left out.

        Args:
            scene: Scene of the rollout.
            count: Largest number of decisions.
            rng: Random generator.

        Returns:
            Pairs of the index of a frame (1 ms) of the recording and the arm joints (7,) (rad), in
            order of time.
        """
        recorder = _PoseRecorder()
        self._episode.reset(scene)
        run_episode(self._episode, self._receiver, seed=int(rng.integers(2**31)), callbacks=[recorder])
        poses = recorder.poses
        chosen = np.sort(rng.choice(len(poses), min(count, len(poses)), replace=False))
        return [poses[number] for number in chosen.tolist()]


class _PoseRecorder(EpisodeCallback):
    """Recorder of frame and arm joints at every decision until the gripper closes."""

    def __init__(self) -> None:
        self.poses: list[tuple[int, Array]] = []

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        if float(decision.receiver_action[ARM_DOF]) < _OPEN or episode.release_reason is not None:
            return
        joints = episode.observe()["robot_joint_position"][:ARM_DOF].astype(np.float64)
        self.poses.append((min(episode.steps, episode.scene.n_frames - 1), joints))


class _ViewWorker:
    """Generator of rendered views in one process."""

    def __init__(self, config: ViewDatasetConfig) -> None:
        self._config = config
        self._data = open_dataset(config.dataset, config.data_dir, config.robot)
        context = make_policy_context(self._data)
        arm = ArmInWorld.for_panda(context.panda_urdf, context.panda, LIMIT_PADDING)
        self._renderer = ViewRenderer(context, arm, GraspLabeller(context, config.labels), config.config)
        self._collector = None if config.weights is None else DaggerCollector(context, config.weights)

    def render_scene(self, number: int) -> GraspViews:
        """Return the views of a scene."""
        # Seeded by the scene, so that files do not depend on the number of processes.
        rng, scene = np.random.default_rng((self._config.seed, number)), self._data.load_scene(number)
        if self._collector is None:
            return self._renderer.render_random(scene, self._config.count, rng)
        poses = self._collector.collect_poses(scene, self._config.count, rng)
        return self._renderer.render_poses(scene, poses, rng)


def generate_views(config: ViewDatasetConfig, scenes: Sequence[int], folder: Path, workers: int | None) -> GraspViews:
    """Return the views of scenes in the order of the scenes; render those of scenes that have no file yet.

    Args:
        config: Configuration of the views.
        scenes: Numbers of the scenes.
        folder: Folder of the files, one per scene, for one configuration only.
        workers: Number of processes, on which the views do not depend; default: one per core.

    Raises:
        DataNotFoundError: `scenes` is empty.
        ResultsError: The folder cannot be written, or a file is damaged.
        HandoverError: A scene cannot be read.
    """

    def make_renderer() -> Callable[[int], GraspViews]:
        return _ViewWorker(config).render_scene

    return join_samples(generate_samples(GraspViews, folder, scenes, make_renderer, "rendering views", workers))
