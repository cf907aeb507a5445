"""Callbacks of the episode loop: base class, and recorder of actions."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF

if TYPE_CHECKING:
    from handover_marl.episode.episode import Episode


@dataclass(frozen=True, eq=False)
class PolicyDecision:
    """Actions of both policies for the next physics steps.

    Attributes:
        receiver_action: (9,) action of the receiver.
        giver_action: (8,) action of the giver.
        planning_time: Wall-clock time of the receiver's policy (s), without rendering; 0 if its last
            action is held.
        receiver_decided: Whether the receiver's policy acted now; otherwise its last action is held.
        giver_decided: Whether the giver's policy acted now; always false for a replayed giver.
        rendering_time: Wall-clock time for rendering the receiver's camera data (s).
    """

    receiver_action: npt.NDArray[np.float32]
    giver_action: npt.NDArray[np.float32]
    planning_time: float
    receiver_decided: bool
    giver_decided: bool
    rendering_time: float


class EpisodeCallback:
    """Base class of callbacks of the episode loop; subclasses override the hooks that they need.

    Callbacks read the episode and do not change it.
    """

    def on_reset(self, episode: "Episode") -> None:
        """Handle the start of an episode; the base class does nothing."""

    def on_decision(self, episode: "Episode", decision: PolicyDecision) -> None:
        """Handle new actions of both policies, before the simulation applies them."""

    def on_step(self, episode: "Episode") -> None:
        """Handle a physics step, after the referee has updated the episode's status."""

    def on_end(self, episode: "Episode") -> None:
        """Handle the end of the episode loop."""


class ActionRecorder(EpisodeCallback):
    """Recorder of the receiver's action and planning time in every physics step.

    HandoverSim's result files contain both.

    Attributes:
        actions: (T, 9) float32 actions; set at the end of an episode.
        times: (T,) planning times (s), zero in steps without a decision; set at the end of an episode.
    """

    actions: npt.NDArray[np.float32]
    times: npt.NDArray[np.float64]

    def __init__(self) -> None:
        self._decisions: list[tuple[int, PolicyDecision]] = []

    def on_reset(self, episode: "Episode") -> None:
        """Discard the records of the last episode."""
        self._decisions = []

    def on_decision(self, episode: "Episode", decision: PolicyDecision) -> None:
        """Record the receiver's action and planning time, and the physics step of the decision."""
        self._decisions.append((episode.steps, decision))

    def on_end(self, episode: "Episode") -> None:
        """Build the arrays of the episode, in which held actions are repeated in every step."""
        self.actions = np.zeros((episode.steps, PANDA_DOF), dtype=np.float32)
        self.times = np.zeros(episode.steps)
        ends = [step for step, _ in self._decisions[1:]] + [episode.steps]
        for (step, decision), end in zip(self._decisions, ends, strict=True):
            self.actions[step:end] = decision.receiver_action
            self.times[step] = decision.planning_time
