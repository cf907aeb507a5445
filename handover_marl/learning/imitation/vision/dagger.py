"""Collection of arm poses that the receiver `vision` reaches, for further training.

The method is dataset aggregation (DAgger; Ross et al., AISTATS 2011).
"""

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.callbacks import EpisodeCallback, PolicyDecision
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import play
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.vision.receiver import VisionReceiver

Array = npt.NDArray[np.float64]

# Commanded finger position below which the gripper is closing (m).
_OPEN = 0.03


class DaggerCollector:
    """Collector of arm poses in rollouts of the receiver `vision`.

    Rollouts run in fast physics with the recorded giver.

    Args:
        context: Robot and task.
        weights: File of a grasp network.
        wait: Time that the receiver waits (s).

    Raises:
        HandoverError: The receiver cannot be created.
    """

    def __init__(self, context: PolicyContext, weights: str, wait: float) -> None:
        self._receiver = VisionReceiver(context, wait, weights=weights)
        self._episode = Episode("fast", context.config)

    def collect_poses(self, scene: Scene, count: int, rng: np.random.Generator) -> list[tuple[int, Array]]:
        """Return up to `count` random pairs of a frame and arm joints (7,), ordered by time."""
        recorder = _PoseRecorder()
        self._episode.reset(scene)
        play(self._episode, self._receiver, seed=int(rng.integers(2**31)), callbacks=[recorder])
        poses = recorder.poses
        chosen = np.sort(rng.choice(len(poses), min(count, len(poses)), replace=False))
        return [poses[number] for number in chosen.tolist()]


class _PoseRecorder(EpisodeCallback):
    """Recorder of frame and arm joints at every decision until the gripper closes."""

    def __init__(self) -> None:
        self.poses: list[tuple[int, Array]] = []

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        if float(decision.receiver_action[ARM_DOF]) < _OPEN or episode.release is not None:
            return
        joints = episode.observe()["robot_joint_position"][:ARM_DOF].astype(np.float64)
        self.poses.append((min(episode.steps, episode.scene.n_frames - 1), joints))
