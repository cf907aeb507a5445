"""Release and status together, in the official order."""

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.contacts import Contacts
from handover_marl.protocol.release import Release, ReleaseRule
from handover_marl.protocol.status import EpisodeStatus, StatusRule


class Referee:
    """Watches an episode step by step.

    Attributes:
        status: The verdict so far; anything but RUNNING ends the episode.
        steps: Physics steps seen.
        release: Why the human let go, or None.
        release_step: The step (from 1) whose contacts made the human let go, or after which it chose to, or None.
        released: Whether the human has let go. Bodies feel it in the next step, the status rule at once.
    """

    def __init__(self, config: ProtocolConfig) -> None:
        self.status = EpisodeStatus.RUNNING
        self.steps = 0
        self.release: Release | None = None
        self.release_step: int | None = None
        self.released = False
        self._release_rule = ReleaseRule(config)
        self._status_rule = StatusRule(config)

    def give(self) -> None:
        """Take note that the giver lets go of its own accord before the next step."""
        if not self.released:
            self.release, self.release_step, self.released = Release.GIVEN, self.steps, True

    def update(self, contacts: Contacts) -> EpisodeStatus:
        """Judge one more physics step."""
        self.steps += 1
        if not self.released:
            self.release = self._release_rule.update(contacts)
            if self.release is not None:
                self.release_step, self.released = self.steps, True
        self.status = self._status_rule.update(contacts, self.released, self.steps)
        return self.status
