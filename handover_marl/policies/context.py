"""What a policy may know beside its observations."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL, PandaConfig, ProtocolConfig, WorldConfig
from handover_marl.datasets.dataset import Dataset


@dataclass(frozen=True)
class PolicyContext:
    """The robot, the task, the objects and their grasps.

    Attributes:
        panda_urdf: Model of the robot, for kinematics.
        grasps: Gives the (n, 4, 4) gripper poses in the object's frame (m) for a class name, or None.
        object_urdf: Gives the model file for a class name.
        config: The world and the rules.
        setup: The official setup that is played, for policies that were trained for each.
    """

    panda_urdf: Path
    grasps: Callable[[str], npt.NDArray[np.float64] | None]
    object_urdf: Callable[[str], Path]
    config: WorldConfig = OFFICIAL
    setup: str = "s0"

    @property
    def panda(self) -> PandaConfig:
        """Where the robot stands and how it starts."""
        return self.config.physics.panda

    @property
    def protocol(self) -> ProtocolConfig:
        """The rules, with the goal."""
        return self.config.protocol


def context_of(dataset: Dataset, config: WorldConfig = OFFICIAL, setup: str = "s0") -> PolicyContext:
    """What policies may know of a dataset."""
    return PolicyContext(dataset.panda_urdf, dataset.grasps, dataset.object_urdf, config, setup)
