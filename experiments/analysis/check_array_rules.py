"""Check that the vectorized referee gives the same outcomes as the stepwise referee.

    python experiments/analysis/check_array_rules.py --data-dir DIR

The contacts of simulated episodes are evaluated by `handover_marl.episode.referee.Referee`, step by
step, and by the array functions of `handover_marl.episode.lockstep`, for several episodes at once,
in segments of one or more steps. The referee states after each segment must be equal. Scenes are
those of a training split, simulated once with each giver, up to the requested number of episodes.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import tyro

from handover_marl import givers, receivers
from handover_marl.episode.callbacks import EpisodeCallback
from handover_marl.episode.episode import Episode
from handover_marl.episode.lockstep import RefereeStateBatch, judge_steps
from handover_marl.episode.loop import play
from handover_marl.episode.referee import EpisodeStatus, Referee, RefereeState
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.pool import PoolConfig
from handover_marl.execution.tasks import map_with_progress
from handover_marl.learning.training.scene_arguments import EvaluationArgs
from handover_marl.simulation.contacts import ContactBatch, Contacts


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Options of the comparison of the vectorized referee with the stepwise one.

    Attributes:
        episodes: Number of episodes.
        receiver: Name of the receiver, with options if there are any.
        givers: Names of the givers; each is simulated in every scene.
        together: Number of episodes that the vectorized referee evaluates at once.
        segments: Numbers of steps that the vectorized referee evaluates at once.
    """

    episodes: int = 1000
    receiver: str = "yang2021"
    givers: tuple[str, ...] = ("replay", "hurried")
    together: int = 8
    segments: tuple[int, ...] = (1, 100)


class Stream(NamedTuple):
    """Contacts of every physics step of an episode, and the referee states after each step."""

    contacts: list[Contacts]
    referee_states: list[RefereeState]


class TraceRecorder(EpisodeCallback):
    """Callback that records the contacts of every step and the states of a referee."""

    def __init__(self, referee: Referee) -> None:
        self._referee, self.stream = referee, Stream([], [])

    def on_step(self, episode: Episode) -> None:
        self._referee.update(episode.contacts)
        self.stream.contacts.append(episode.contacts)
        self.stream.referee_states.append(self._referee.get_state())

    def on_end(self, episode: Episode) -> None:
        assert self._referee.status == episode.status


class Checked(NamedTuple):
    """Outcomes of episodes, number of compared referee states, and messages on differences."""

    ends: list[int]
    compared: int
    wrong: list[str]


class Checker:
    """Simulator that compares both implementations of the referee in one process."""

    def __init__(self, args: Args) -> None:
        self._args, self._data = args, args.open_dataset()
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._givers = {name: givers.make(name, self._data, setup=args.setup) for name in args.givers}
        self._episode = Episode(args.physics)

    def check(self, tasks: Sequence[tuple[str, int]]) -> Checked:
        """Compare both implementations of the referee on pairs of giver name and scene number."""
        streams = [self._stream(*task) for task in tasks]
        compared, wrong = 0, []
        for segment in self._args.segments:
            for number, step, found, expected in self._judged(streams, segment):
                compared += 1
                if found != expected:
                    wrong.append(f"{tasks[number]}, step {step}, {segment} at once: {found}, not {expected}")
        return Checked([stream.referee_states[-1].status for stream in streams], compared, wrong)

    def _stream(self, giver: str, scene: int) -> Stream:
        recorder = TraceRecorder(Referee(self._episode.config.protocol))
        self._episode.reset(self._data.load_scene(scene))
        play(self._episode, self._receiver, self._givers[giver], seed=0, callbacks=[recorder])
        return recorder.stream

    def _judged(self, streams: Sequence[Stream], most: int) -> list[tuple[int, int, RefereeState, RefereeState]]:
        """Return episode index, last step and referee states (vectorized, stepwise) by segment."""
        rules = self._episode.config.protocol
        arrays = [ContactBatch.from_contacts(stream.contacts, rules) for stream in streams]
        referee_states = [Referee(rules).get_state() for _ in streams]
        found = []
        while running := [number for number, stands in enumerate(referee_states) if not stands.status]:
            begun = [referee_states[number].steps for number in running]
            steps = min(
                most, *(len(streams[number].contacts) - first for number, first in zip(running, begun, strict=True))
            )
            parts = [
                [field[first : first + steps] for field in arrays[number]]
                for number, first in zip(running, begun, strict=True)
            ]
            seen = ContactBatch(*(np.concatenate(fields, axis=1) for fields in zip(*parts, strict=True)))
            last, verdicts = judge_steps(
                RefereeStateBatch.from_states([referee_states[number] for number in running]), seen, rules
            )
            for place, number in enumerate(running):
                referee_states[number] = verdicts.select(place)
                step = begun[place] + int(last[place])
                found.append(
                    (
                        number,
                        step,
                        _trimmed(referee_states[number]),
                        _trimmed(streams[number].referee_states[step]),
                    )
                )
        return found


def _trimmed(state: RefereeState) -> RefereeState:
    """Return a referee state without counters that cannot influence the outcome any more."""
    state = state._replace(goal_steps=0) if state.status else state
    return state._replace(active_steps=0, passive_steps=0) if state.release >= 0 else state


def main(args: Args) -> None:
    data = args.open_dataset()
    scenes = data.list_scenes(args.setup, "train")
    tasks = [(giver, scene) for giver in args.givers for scene in scenes][: args.episodes]
    groups = [tasks[first : first + args.together] for first in range(0, len(tasks), args.together)]
    ends: Counter[int] = Counter()
    compared, wrong = 0, []
    for _, checked in map_with_progress(
        lambda: Checker(args).check, groups, "checking", PoolConfig(args.workers), True
    ):
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
    print(format_table(["end", "episodes"], [list(row) for row in names]))
    print(f"arrays and referee compared {compared} times, {len(wrong)} differences")
    if wrong:
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Args))
