"""One recorded episode: what was seen and done, and how it ended."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from handover_marl._version import __version__
from handover_marl.benchmarking.episodes import EpisodeResult
from handover_marl.episode.observations import Observation
from handover_marl.run import Run, reference_of

_NONE = -1


@dataclass(frozen=True)
class EpisodeFacts:
    """What there is to know about an episode without its arrays.

    Attributes:
        scene_id: Number of the scene.
        object_name: Class of the object that was handed over, e.g. "025_mug".
        subject: The person who gave it.
        side: "right" or "left" hand.
        outcome: "success", or "contact", "drop", "timeout", joined by "+" where they came together.
        status: The same as bits of `handover_marl.EpisodeStatus`.
        steps: Physics steps (ms) until the end.
        release_step: The step whose contacts made the person let go; -1 if there was none.
        receiver: The robot's policy.
        giver: The person's.
        physics: Kind of physics.
        dataset: Where the scene comes from.
        robot: Which Panda.
        seed: Of what policies and camera drew.
        models: Which hand the scene was played with and what else was not HandoverSim's own; empty if all is.
        fingerprint: Hash of the scene's data files.
        version: Version of this library.
    """

    scene_id: int
    object_name: str
    subject: str
    side: str
    outcome: str
    status: int
    steps: int
    release_step: int
    receiver: str
    giver: str
    physics: str
    dataset: str
    robot: str
    seed: int
    models: str
    fingerprint: str
    version: str

    @classmethod
    def of(cls, result: EpisodeResult, run: Run) -> "EpisodeFacts":
        """Of an episode of a run that was resolved."""
        return cls(
            scene_id=_NONE if result.scene_id is None else result.scene_id,
            object_name=result.object_name or "",
            subject=result.subject or "",
            side=result.side or "",
            outcome=result.status.label,
            status=int(result.status),
            steps=result.steps,
            release_step=_NONE if result.release_step is None else result.release_step,
            receiver=reference_of(run.receiver).label,
            giver=reference_of(run.giver).label,
            physics=run.physics,
            dataset=run.dataset,
            robot=run.robot,
            seed=run.seed,
            models=result.models or "",
            fingerprint=result.fingerprint or "",
            version=__version__,
        )

    @property
    def success(self) -> bool:
        """Whether the handover was completed."""
        return self.outcome == "success"


@dataclass(frozen=True, eq=False)
class Demonstration:
    """An episode of T decisions of the receiver and G of the giver.

    The receiver's i-th action holds from physics step `steps[i]` to `steps[i + 1]`, the giver's j-th from
    `giver_steps[j]` until its next; applied at these steps they give the same episode again, to the bit.

    Attributes:
        observations: Arrays (T + 1, ...) as the environment's receiver sees them (`receiver_observation_space`): at
            every decision, and at the end.
        actions: (T, 9) float32 target joint positions, 7 arm (rad), 2 fingers (m).
        rewards: (T,) float64, 1 for the decision under which the handover was completed, else 0.
        terminations: (T,) bool, whether success, contact or a drop ended the episode then.
        truncations: (T,) bool, whether its time ended then.
        steps: (T + 1,) int64 physics steps (ms) since the start, at every observation.
        giver_steps: (G,) int64 physics steps at which a giver was asked; none for one that only replays.
        giver_actions: (G, 8) float32 deviations from the replay, see `handover_marl.episode.spaces`.
        facts: What else there is to know.
    """

    observations: Observation
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float64]
    terminations: npt.NDArray[np.bool_]
    truncations: npt.NDArray[np.bool_]
    steps: npt.NDArray[np.int64]
    giver_steps: npt.NDArray[np.int64]
    giver_actions: npt.NDArray[np.float32]
    facts: EpisodeFacts

    def __len__(self) -> int:
        """Decisions of the receiver."""
        return len(self.actions)


def checked_value(name: str, value: Any, kind: type) -> Any:
    """A fact as it was read, as a plain number or text.

    Raises:
        TypeError: It is of another kind.
    """
    plain = value.item() if isinstance(value, np.generic) else value
    if type(plain) is not kind:
        raise TypeError(f"{name} is {type(plain).__name__}, expected {kind.__name__}")
    return plain
