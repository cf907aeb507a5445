"""What every policy is, the person's as well as the robot's."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.episode.observations import ALL, Observation

Action = npt.NDArray[np.float32]


class Policy(ABC):
    """Turns observations into actions of one agent.

    A policy sees observations only and never holds an environment. Its constructor may take `context`, a
    `PolicyContext`, and options with defaults, which can then be given with its name (`omg:wait=1.5`).

    Attributes:
        agent: Whose policy it is, "giver" or "receiver"; None if either's.
        name: What tables and files call it.
        control_period: How often it decides (s); a whole number of milliseconds.
        sight: What a receiver wants to be shown of the wrist camera: "points", "clouds", "images", or None; pictures
            are drawn only when it is asked, and drawing is not planning time. See
            `handover_marl.episode.sight.sight_space`.
        observes: "all", or "sight": proprioception and sight alone, so that the true pose cannot be used by accident.
        file_options: Options of the constructor that name a file or a folder, which is sent along to other machines.
    """

    agent: ClassVar[str | None] = None
    name: ClassVar[str]
    control_period: ClassVar[float] = 0.1
    file_options: ClassVar[tuple[str, ...]] = ()
    sight: str | None = None
    observes: str = ALL

    def prepare(self, object_names: Sequence[str]) -> None:  # noqa: B027
        """Get ready for episodes with these objects, before the clock of one runs.

        For what takes long and is kept, such as trying out grasps. It is called before `reset`, and may be called with
        the same objects again and again; what it finds out must depend on nothing else.

        Args:
            object_names: YCB names, e.g. "025_mug", the one that is handed over first.
        """

    @abstractmethod
    def reset(self, seed: int | None = None) -> None:
        """Forget the last episode.

        Args:
            seed: For what the policy draws. It says nothing about the scene.
        """

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Decide on an action, an element of the agent's action space, from an element of its observation space."""

    @property
    def label(self) -> str:
        """What results are filed under: the name, and what else tells two apart."""
        return self.name

    @property
    def weights_hash(self) -> str:
        """A hash of the weights that it was made with, if any: with others its results are not the same any more."""
        return ""

    @property
    def wait(self) -> float | None:
        """How long (s) it stays away from the start of every episode, so that results can say it; None if unknown."""
        return 0.0

    @property
    def intention(self) -> npt.NDArray[np.float64] | None:
        """(k, 7) poses through which the robot means to bring its hand link, for replays; None if it has none in mind.

        World frame, xyz (m) and quaternion xyzw, the next one first; the last one is where it means to grasp. To ask
        for it changes nothing.
        """
        return None

    @property
    def hold_time(self) -> float:
        """How long (s) the last action stands before the policy wants to be asked again.

        A policy may override it to decide more often in some phases than in others. Whole episodes (`play`, the
        benchmark) ask that late; an environment's step is one control period long, and a frozen partner in it is
        asked at the first step that begins when this time is over.
        """
        return self.control_period
