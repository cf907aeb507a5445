"""What every receiver is: a policy that turns observations into target joint positions."""

from abc import abstractmethod
from typing import ClassVar

from handover_marl.episode.observations import Observation
from handover_marl.policies.context import PolicyContext
from handover_marl.policies.policy import Action, Policy


class Receiver(Policy):
    """A policy for the robot.

    Pass the class wherever a receiver is wanted, or register it for others through the entry-point group
    `handover_marl.receivers`.

    Args:
        context: The robot, the task, the objects and their grasps.
    """

    agent: ClassVar[str | None] = "receiver"

    def __init__(self, context: PolicyContext) -> None:
        self.context = context

    @abstractmethod
    def act(self, observation: Observation) -> Action:
        """Decide on nine target joint positions, 7 arm (rad) and 2 fingers (m), float32.

        Args:
            observation: As described in `handover_marl.episode.observations.receiver_observation_space`.
        """
