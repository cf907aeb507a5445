"""Collection of arm poses that the receiver `vision` reaches, for further training.

The method is dataset aggregation (DAgger; Ross et al., AISTATS 2011).
"""

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_DOF
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.callbacks import EpisodeCallback, PolicyDecision
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import run_episode
from handover_marl.policies.policy import PolicyContext
from handover_marl.receivers.vision.receiver import VisionReceiver

Array = npt.NDArray[np.float64]

# Commanded finger position below which the gripper is closing (m).
_OPEN = 0.03


class DaggerCollector:
    """Collector of arm joint positions in rollouts of the receiver `vision`.

    Rollouts run in fast physics; the giver replays the recording.

    Args:
        context: Robot and task.
        weights: Weight file of the receiver's grasp network.
        wait: Time for which the receiver waits at the start of an episode (s).

    Raises:
        HandoverError: The receiver cannot be created.
    """

    def __init__(self, context: PolicyContext, weights: str, wait: float) -> None:
        self._receiver = VisionReceiver(context, wait, weights=weights)
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
