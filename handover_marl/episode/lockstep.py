"""Playing worlds that take many steps at once: rolled together, judged as arrays, cut where something happens."""

from collections.abc import Iterable
from dataclasses import dataclass

from handover_marl.config import ProtocolConfig
from handover_marl.protocol.array_rules import Verdicts, judge
from handover_marl.protocol.referee import Referee
from handover_marl.sim.world import RollingWorld

# Steps taken at once: what is behind the step in which something happens is taken in vain.
_CHUNK = 100
# Worlds rolled at once: what is felt in more of them does not fit into the processor's own memory.
_ABREAST = 32


@dataclass(eq=False)
class Stretch:
    """Steps of one world that are to be played, and how many of them were.

    Attributes:
        world: The world, led by a motion.
        referee: Judges it.
        robot_target: Nine joint targets (rad, m), float32 values.
        left: Steps still to be played, at most as many as the motion has rows left.
        done: Steps that were played.
    """

    world: RollingWorld
    referee: Referee
    robot_target: list[float]
    left: int
    done: int = 0

    @property
    def over(self) -> bool:
        """Whether there is nothing more to play."""
        return self.left == 0 or bool(self.referee.status)


def play_together(stretches: Iterable[Stretch], rules: ProtocolConfig) -> None:
    """Play all stretches to their ends, or to those of their episodes.

    Raises:
        SimulationError: The engine broke down; the worlds' states mean nothing any more.
    """
    running = [stretch for stretch in stretches if not stretch.over]
    while running:
        # Whether a world stays dormant is said when it is prepared.
        _prepare([stretch for stretch in running if stretch.world.dormant])
        groups: dict[object, list[tuple[int, Stretch]]] = {}
        for stretch in running:
            kind, place = stretch.world.companion
            groups.setdefault(kind, []).append((place, stretch))
        # Worlds of small groups are prepared beside those of others; a large group is, as it is rolled, by itself.
        few = [stretch for group in groups.values() if len(group) < _ABREAST for _, stretch in group]
        few = [stretch for stretch in few if not stretch.world.dormant]
        _prepare(few)
        for group in groups.values():
            ordered = [stretch for _, stretch in sorted(group, key=lambda entry: entry[0])]
            for first in range(0, len(ordered), _ABREAST):
                _roll(ordered[first : first + _ABREAST], rules)
        running = [stretch for stretch in running if not stretch.over]


def _prepare(stretches: list[Stretch]) -> None:
    for first in range(0, len(stretches), _ABREAST):
        part = stretches[first : first + _ABREAST]
        part[0].world.prepare([stretch.world for stretch in part], [stretch.robot_target for stretch in part])


def _roll(stretches: list[Stretch], rules: ProtocolConfig) -> None:
    steps = min(_CHUNK, *(min(stretch.left, stretch.world.ahead) for stretch in stretches))
    worlds = [stretch.world for stretch in stretches]
    rolled = worlds[0].roll(worlds, [stretch.robot_target for stretch in stretches], steps, rules)
    before = Verdicts.of([stretch.referee.standing() for stretch in stretches])
    last, verdicts = judge(before, rolled.contacts, rules)
    for number, stretch in enumerate(stretches):
        taken = int(last[number]) + 1
        if taken < steps:
            rolled.cut(number, taken)
        stretch.left, stretch.done = stretch.left - taken, stretch.done + taken
        held = not stretch.referee.released
        stretch.referee.resume(verdicts.standing(number))
        if held and stretch.referee.released:
            stretch.world.release_target()
