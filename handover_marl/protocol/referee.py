"""Release and status together, in the official order."""

from typing import NamedTuple

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.contacts import Contacts
from handover_marl.protocol.release import Release, ReleaseRule
from handover_marl.protocol.status import EpisodeStatus, StatusRule

_RELEASES = tuple(Release)


class Standing(NamedTuple):
    """How an episode stands, all in numbers.

    Attributes:
        status: Bits of the `EpisodeStatus`.
        steps: Physics steps seen.
        release: Why the human let go, an index into `tuple(Release)`, or -1.
        release_step: The step whose contacts made the human let go, or -1.
        active_steps: Steps in a row for which the condition of `Release.ACTIVE` has held.
        passive_steps: Likewise that of `Release.PASSIVE`.
        goal_steps: Steps in a row for which the object has been held at the goal.
    """

    status: int
    steps: int
    release: int
    release_step: int
    active_steps: int
    passive_steps: int
    goal_steps: int


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

    def standing(self) -> Standing:
        """How things stand."""
        return Standing(
            status=int(self.status),
            steps=self.steps,
            release=-1 if self.release is None else _RELEASES.index(self.release),
            release_step=-1 if self.release_step is None else self.release_step,
            active_steps=self._release_rule.active_steps,
            passive_steps=self._release_rule.passive_steps,
            goal_steps=self._status_rule.goal_steps,
        )

    def resume(self, standing: Standing) -> None:
        """Go on from there."""
        self.status, self.steps = EpisodeStatus(standing.status), standing.steps
        self.released = standing.release >= 0
        self.release = _RELEASES[standing.release] if self.released else None
        self.release_step = standing.release_step if self.released else None
        self._release_rule.active_steps = standing.active_steps
        self._release_rule.passive_steps = standing.passive_steps
        self._status_rule.goal_steps = standing.goal_steps
