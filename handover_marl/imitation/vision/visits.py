"""Where the receiver `vision` comes by, so that its network learns from what it meets (DAgger, Ross et al., 2011)."""

import numpy as np
import numpy.typing as npt

from handover_marl.config import ARM_JOINTS
from handover_marl.datasets.scene import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.watchers import Decision, Watcher
from handover_marl.policies.context import PolicyContext
from handover_marl.receivers.vision.vision_receiver import VisionReceiver

Array = npt.NDArray[np.float64]

# Fingers commanded to less than this are closing (m): what comes then is not looked at.
_OPEN = 0.03


class Visits:
    """Plays scenes in fast physics with replayed givers.

    Args:
        context: The robot and the task.
        weights: File of a grasp network.
        wait: How long the receiver waits (s).

    Raises:
        HandoverError: The receiver cannot be made.
    """

    def __init__(self, context: PolicyContext, weights: str, wait: float) -> None:
        self._receiver = VisionReceiver(context, wait, weights=weights)
        self._episode = Episode("fast", context.config)

    def places(self, scene: Scene, count: int, rng: np.random.Generator) -> list[tuple[int, Array]]:
        """Up to `count` frames of a scene and the joints (7,) of the arm then, in their order."""
        notes = _Notes()
        self._episode.reset(scene)
        play(self._episode, self._receiver, seed=int(rng.integers(2**31)), watchers=[notes])
        places = notes.places
        chosen = np.sort(rng.choice(len(places), min(count, len(places)), replace=False))
        return [places[number] for number in chosen.tolist()]


class _Notes(Watcher):
    def __init__(self) -> None:
        self.places: list[tuple[int, Array]] = []

    def decided(self, episode: Episode, decision: Decision) -> None:
        if float(decision.robot[ARM_JOINTS]) < _OPEN or episode.release is not None:
            return
        joints = episode.observe()["robot_joint_position"][:ARM_JOINTS].astype(np.float64)
        self.places.append((min(episode.steps, episode.scene.n_frames - 1), joints))
