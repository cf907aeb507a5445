"""A receiver that sees points alone: it chooses among grasps that a network tells, and moves as `reactive` does.

At every look a network (`handover_marl.networks.grasp_network`) tells, at many points of the object, the grasp there
and how good it is beside the person's hand. What remains is computed: which of them to go for, the way there round what
is seen, and the last centimetres with the object as it moves. It knows neither true poses nor models of objects, nor
whether the person has let go: it carries the object off once its fingers have stopped on something.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.assets.shipped_weights import vision_weights
from handover_marl.episode.observations import SIGHT, Observation
from handover_marl.episode.sight import POINTS
from handover_marl.errors import OptionError
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action
from handover_marl.receivers.reactive.reactive_config import ReactiveConfig
from handover_marl.receivers.reactive.reactive_receiver import Phase, ReactiveReceiver
from handover_marl.receivers.reactive.reactive_view import View
from handover_marl.receivers.vision.percept import GraspFunction, Percept, PerceptConfig
from handover_marl.receivers.vision.vision_view import VisionView

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class VisionConfig:
    """What differs from `reactive`.

    Attributes:
        percept: How views become grasps.
        search: What was not seen for so long (s) is looked for.
        still: Fingers that moved by less than this since the last look have stopped (m), and
        held_time: after so long (s) the person is taken to have let go, or at the latest
        longest: so long after they began to close (s), if there is something between them.
    """

    percept: PerceptConfig = field(default_factory=PerceptConfig)
    search: float = 0.25
    still: float = 0.0004
    held_time: float = 0.15
    longest: float = 0.5


def vision_reactive_config() -> ReactiveConfig:
    """Constants of `reactive` for who sees points.

    Looks take longer, qualities count the room already, and what is seen of an object near the gripper does not tell
    well enough how it moves to close in on it meanwhile.
    """
    config = ReactiveConfig()
    return replace(
        config,
        near_period=0.05,
        grasps=replace(config.grasps, lack=10.0, least_room=0.0, bare_room=0.0, waiting=np.inf),
        approach=replace(config.approach, object_speed=0.08, hover_speed=0.15, close_period=0.05),
    )


class VisionReceiver(ReactiveReceiver):
    """See the module.

    Args:
        context: The robot and the task; models and grasps of objects are not used.
        wait: How long to stay at the waiting pose (s).
        risk: Trades success (0) against speed (1).
        weights: File of a grasp network; default: the one that ships for the setup.
        tells: Instead of a file: what tells grasps.
        vision: How it looks.

    Raises:
        OptionError: `wait` or `risk` is out of range, or PyTorch is missing.
        DataNotFoundError, DataFormatError: The weights cannot be read.
    """

    name = "vision"
    file_options = ("weights",)
    sight = POINTS
    observes = SIGHT

    def __init__(
        self,
        context: PolicyContext,
        wait: float = 0.0,
        risk: float = 0.5,
        weights: str | None = None,
        tells: GraspFunction | None = None,
        vision: VisionConfig | None = None,
    ) -> None:
        super().__init__(context, wait, risk, vision_reactive_config())
        self.vision = vision or VisionConfig()
        self._tells, self._weights_hash = _chosen(weights, tells, context.setup)
        self._label = self.name if weights is None else f"{self.name}@{self._weights_hash}"

    @property
    def label(self) -> str:
        """The name, and which weights."""
        return self._label

    @property
    def weights_hash(self) -> str:
        """Of the grasp network's."""
        return self._weights_hash

    def prepare(self, object_names: Sequence[str]) -> None:
        """Nothing: it does not know objects."""

    def reset(self, seed: int | None = None) -> None:
        """Forget the episode."""
        super().reset(seed)
        self.choice.forget()
        self._fingers, self._stopped = np.zeros(2), np.inf

    def _new_view(self, seed: int | None) -> View:
        self.percept = Percept(self._tells, self.vision.percept, seed)
        return VisionView(self._arm, self.config, self.percept)

    def _see(self, observation: Observation) -> None:
        if self.phase in (Phase.CLOSE, Phase.RETREAT):
            # What is between the fingers is not seen, and what was chosen is not changed any more.
            self._view.feel(observation)
            return
        chosen = self.choice.chosen
        for number, until in self.choice.failed.items():
            self.percept.fail(self.choice.grasps[number], until)
        self.percept.choose(None if chosen is None else self.choice.grasps[chosen.number])
        helpless = bool(self.choice.trouble) or not len(self.choice.grasps)
        self.percept.wider = helpless and self._view.settled
        self._view.see(observation)
        self.choice.offer(
            self.percept.grasps, self.percept.prices, self.percept.surface, 0 if self.percept.follows else None
        )
        self._motion.surface = self.percept.surface

    def _approach(self) -> Action:
        if self.percept.unseen(self._view.time) > self.vision.search:
            # From farther away more is in view.
            return self._motion.home_apart()
        return super()._approach()

    def _let_go(self, observation: Observation) -> bool:
        view, config = self._view, self.vision
        moved = float(np.abs(view.fingers - self._fingers).max())
        self._fingers = view.fingers
        if moved > config.still or float(view.fingers.max()) < self.config.approach.empty:
            self._stopped = view.time
        late = view.time - self._since > config.longest and float(view.fingers.max()) > self.config.approach.empty
        return late or view.time - self._stopped > config.held_time

    def _carry(self) -> Action:
        # It may have closed on what the person did not let go of, or lost it: then there is something to go back for.
        if float(self._view.fingers.max()) < self.config.approach.empty:
            return self._miss()
        return super()._carry()

    def _close(self, released: bool) -> Action:
        if self._since == self._view.time:
            self._stopped = self._view.time
        return super()._close(released)


def _chosen(weights: str | None, tells: GraspFunction | None, setup: str) -> tuple[GraspFunction, str]:
    """What tells grasps, and the hash of its weights, if any."""
    if tells is not None:
        if weights is not None:
            raise OptionError("receiver 'vision' takes weights or a function, not both")
        return tells, ""
    if importlib.util.find_spec("torch") is None:
        raise OptionError("receiver 'vision' needs PyTorch: pip install 'handover-marl[train]'")
    # Only who has no function of his own needs it.
    from handover_marl.receivers.vision.grasp_teller import grasp_teller

    return grasp_teller(weights or _shipped(setup))


def _shipped(setup: str) -> Path:
    path = vision_weights(setup)
    if not path.is_file():
        raise OptionError(
            f"no weights of receiver 'vision' ship for setup {setup!r}: train them (experiments/train_vision.py "
            f"--setup {setup}) and give weights=FILE; those of another setup may know scenes of this one's test split"
        )
    return path
