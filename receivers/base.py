"""What every receiver is: a policy that turns observations into target joint positions."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import PandaConfig, ProtocolConfig
from handover_marl.observations import Observation

#: Where a receiver waits for the handover (7 arm joints, rad; 2 fingers, m), as in HandoverSim's baselines.
WAITING_JOINTS = (-0.0593, -1.6124, -0.1970, -2.5300, -0.0952, 1.6780, 0.5870, 0.04, 0.04)

#: Finger targets (m).
OPEN, CLOSED = 0.04, 0.0

Action = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ReceiverContext:
    """What a receiver may know beside its observations: the robot, the task, the objects and their grasps.

    Attributes:
        panda_urdf: Model of the robot, for kinematics.
        grasps: Gives the (n, 4, 4) gripper poses in the object's frame (m) for a class name, or None.
        object_urdf: Gives the model file for a class name.
        panda: Where the robot stands and how it starts.
        protocol: The rules, with the goal.
    """

    panda_urdf: Path
    grasps: Callable[[str], npt.NDArray[np.float64] | None]
    object_urdf: Callable[[str], Path]
    panda: PandaConfig = field(default_factory=PandaConfig)
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)


class Receiver(ABC):
    """A policy for the robot.

    A receiver sees observations only and never holds an environment. Register one for others through the
    entry-point group `handover_marl.receivers`.

    Attributes:
        name: What it is registered under.
        control_period: How often it decides (s); a whole number of milliseconds.
    """

    name: ClassVar[str]
    control_period: ClassVar[float] = 0.1

    def __init__(self, context: ReceiverContext) -> None:
        self.context = context

    @abstractmethod
    def reset(self, seed: int | None = None) -> None:
        """Forget the last episode."""

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Decide on nine target joint positions, 7 arm (rad) and 2 fingers (m), float32.

        Args:
            observation: As described in `handover_marl.observations.observation_space`.
        """

    @property
    def label(self) -> str:
        """What results are filed under: the name, and what else tells two apart."""
        return self.name

    @property
    def hold_time(self) -> float:
        """How long (s) the last action stands before the receiver wants to be asked again.

        The benchmark asks that late; a receiver may override it to decide more often in some phases than in
        others. An environment asks once every control period, whatever this says.
        """
        return self.control_period
