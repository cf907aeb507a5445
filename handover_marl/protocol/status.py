"""How an episode stands: running, won, or lost and why (HandoverSim, Sec. IV-C)."""

import math
from enum import IntFlag

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.contacts import Contacts


class EpisodeStatus(IntFlag):
    """The official bit flags; failures may combine."""

    RUNNING = 0
    SUCCESS = 1
    HUMAN_CONTACT = 2
    OBJECT_DROP = 4
    TIMEOUT = 8

    @property
    def label(self) -> str:
        """In words, e.g. `contact+drop`."""
        words = {1: "success", 2: "contact", 4: "drop", 8: "timeout"}
        return "+".join(word for bit, word in words.items() if self & bit) or "running"


class StatusRule:
    """Judges one step after another.

    Attributes:
        goal_steps: Steps in a row for which the object has been held at the goal.
    """

    def __init__(self, config: ProtocolConfig) -> None:
        self._config = config
        self.goal_steps = 0

    def update(self, contacts: Contacts, released: bool, steps: int) -> EpisodeStatus:
        """The status after a step.

        Args:
            contacts: What touched in this step.
            released: Whether the human has let go, in this step or before.
            steps: Physics steps simulated so far, this one included.
        """
        status = EpisodeStatus.HUMAN_CONTACT if contacts.robot_hand else EpisodeStatus.RUNNING
        if released:
            if self._dropped(contacts):
                status |= EpisodeStatus.OBJECT_DROP
            if not status and self._held_at_goal(contacts):
                return EpisodeStatus.SUCCESS
        if steps >= self._config.horizon_steps:
            status |= EpisodeStatus.TIMEOUT
        return status

    def _dropped(self, contacts: Contacts) -> bool:
        fallen = contacts.object_height < self._config.drop_height
        return not contacts.both_fingers and (contacts.object_supported or fallen)

    def _held_at_goal(self, contacts: Contacts) -> bool:
        near = math.dist(contacts.gripper_position, self._config.goal_center) < self._config.goal_radius
        self.goal_steps = self.goal_steps + 1 if near and contacts.both_fingers else 0
        return self.goal_steps >= self._config.success_steps
