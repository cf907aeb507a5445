"""Do rules as arrays say what the rules say step by step? Played on the contacts of whole episodes.

    python experiments/check_array_rules.py --data-dir DIR

Every episode's contacts are judged by the referee, one step after the other, and by the arrays of
`handover_marl.protocol.array_rules`: several episodes at once in single steps, each of which must leave the episode as
the referee does; and in stretches, after each of which it must stand as it did there. Scenes are those of a training
split, played once with each giver until there are enough.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import tyro

from handover_marl import givers, receivers
from handover_marl.benchmarking.tables import table
from handover_marl.datasets import open_dataset
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.watchers import Watcher
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import worked_on
from handover_marl.protocol.array_rules import ContactArrays, Verdicts, judge
from handover_marl.protocol.contacts import Contacts
from handover_marl.protocol.referee import Referee, Standing
from handover_marl.protocol.status import EpisodeStatus


@dataclass(frozen=True)
class Args:
    """What is played.

    Attributes:
        episodes: How many.
        receiver: Who takes.
        givers: Who gives, one after the other.
        setup: Official setup, s0 to s3.
        physics: fast or mujoco, or exact, which takes longer.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic or auto.
        together: Episodes judged at once.
        stretches: Steps judged at once.
        workers: Processes; default: one a core.
    """

    episodes: int = 1000
    receiver: str = "yang2021"
    givers: tuple[str, ...] = ("replay", "hurried")
    setup: str = "s0"
    physics: str = "fast"
    data_dir: str | None = None
    dataset: str = "auto"
    together: int = 8
    stretches: tuple[int, ...] = (1, 100)
    workers: int | None = None


class Stream(NamedTuple):
    """An episode's contacts, step by step, and how it stood after each."""

    contacts: list[Contacts]
    standings: list[Standing]


class Recorder(Watcher):
    """Keeps a stream, judged by a referee of its own."""

    def __init__(self, referee: Referee) -> None:
        self._referee, self.stream = referee, Stream([], [])

    def stepped(self, episode: Episode) -> None:
        self._referee.update(episode.contacts)
        self.stream.contacts.append(episode.contacts)
        self.stream.standings.append(self._referee.standing())

    def ended(self, episode: Episode) -> None:
        assert self._referee.status == episode.status


class Checked(NamedTuple):
    """How some episodes ended, and how often arrays were compared with the referee and said otherwise."""

    ends: list[int]
    compared: int
    wrong: list[str]


class Checker:
    """Plays and checks some episodes at once, in one process."""

    def __init__(self, args: Args) -> None:
        self._args, self._data = args, open_dataset(args.dataset, args.data_dir)
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._givers = {name: givers.make(name, self._data, setup=args.setup) for name in args.givers}
        self._episode = Episode(args.physics)

    def check(self, tasks: Sequence[tuple[str, int]]) -> Checked:
        """Episodes of givers and scenes."""
        streams = [self._stream(*task) for task in tasks]
        compared, wrong = 0, []
        for stretch in self._args.stretches:
            for number, step, found, expected in self._judged(streams, stretch):
                compared += 1
                if found != expected:
                    wrong.append(f"{tasks[number]}, step {step}, {stretch} at once: {found}, not {expected}")
        return Checked([stream.standings[-1].status for stream in streams], compared, wrong)

    def _stream(self, giver: str, scene: int) -> Stream:
        recorder = Recorder(Referee(self._episode.config.protocol))
        self._episode.reset(self._data.scene(scene))
        play(self._episode, self._receiver, self._givers[giver], seed=0, watchers=[recorder])
        return recorder.stream

    def _judged(self, streams: Sequence[Stream], most: int) -> list[tuple[int, int, Standing, Standing]]:
        """Of each stretch: number of the episode, its last step, and how it stands by arrays and by the referee."""
        rules = self._episode.config.protocol
        arrays = [ContactArrays.of(stream.contacts, rules) for stream in streams]
        standings = [Referee(rules).standing() for _ in streams]
        found = []
        while running := [number for number, stands in enumerate(standings) if not stands.status]:
            begun = [standings[number].steps for number in running]
            steps = min(
                most, *(len(streams[number].contacts) - first for number, first in zip(running, begun, strict=True))
            )
            parts = [
                [field[first : first + steps] for field in arrays[number]]
                for number, first in zip(running, begun, strict=True)
            ]
            seen = ContactArrays(*(np.concatenate(fields, axis=1) for fields in zip(*parts, strict=True)))
            last, verdicts = judge(Verdicts.of([standings[number] for number in running]), seen, rules)
            for place, number in enumerate(running):
                standings[number] = verdicts.standing(place)
                step = begun[place] + int(last[place])
                found.append((number, step, _told(standings[number]), _told(streams[number].standings[step])))
        return found


def _told(standing: Standing) -> Standing:
    """Without counts that are of no use any more: that for the goal after the end, those for letting go after that."""
    standing = standing._replace(goal_steps=0) if standing.status else standing
    return standing._replace(active_steps=0, passive_steps=0) if standing.release >= 0 else standing


def main(args: Args) -> None:
    data = open_dataset(args.dataset, args.data_dir)
    scenes = data.split(args.setup, "train")
    tasks = [(giver, scene) for giver in args.givers for scene in scenes][: args.episodes]
    groups = [tasks[first : first + args.together] for first in range(0, len(tasks), args.together)]
    ends: Counter[int] = Counter()
    compared, wrong = 0, []
    for _, checked in worked_on(lambda: Checker(args).check, groups, "checking", PoolConfig(args.workers), True):
        ends.update(checked.ends)
        compared += checked.compared
        wrong += checked.wrong
    for line in wrong:
        print(line)
    played = Counter(giver for giver, _ in tasks)
    print(
        f"{data.name}, {args.setup} train, {len(tasks)} episodes ({', '.join(f'{n} {g}' for g, n in played.items())}), "
        f"receiver {args.receiver}, {args.physics} physics"
    )
    names = [(EpisodeStatus(status).name or "", str(count)) for status, count in ends.most_common()]
    print(table(["end", "episodes"], [list(row) for row in names]))
    print(f"arrays and referee compared {compared} times, {len(wrong)} differences")
    if wrong:
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Args))
