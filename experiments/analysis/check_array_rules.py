"""Check that the vectorized referee gives the same outcomes as the stepwise referee.

    python experiments/analysis/check_array_rules.py --data-dir DIR

The contacts of simulated episodes are evaluated by `handover_marl.episode.referee.Referee`, step by
step, and by the array functions of `handover_marl.episode.lockstep`, for several episodes at once,
in segments of one or more steps. The referee states after each segment must be equal. The scenes
are from a training split. Each scene is simulated once with each giver, up to the requested number
of episodes.
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
from handover_marl.episode.loop import run_episode
from handover_marl.episode.referee import EpisodeStatus, Referee, RefereeState
from handover_marl.evaluation.reports.tables import format_table
from handover_marl.execution.options import PoolConfig
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
        segments: Numbers of steps that the vectorized referee evaluates at once; the comparison is
            made for each number.
    """

    episodes: int = 1000
    receiver: str = "yang2021"
    givers: tuple[str, ...] = ("replay", "hurried")
    together: int = 8
    segments: tuple[int, ...] = (1, 100)


class RefereeRecord(NamedTuple):
    """Contacts in every physics step of an episode, and the referee's state after every step.

    Attributes:
        contacts: Contacts in each step.
        referee_states: State of the stepwise referee after each step.
    """

    contacts: list[Contacts]
    referee_states: list[RefereeState]


class RefereeRecorder(EpisodeCallback):
    """Callback that records the contacts in every step and a referee's state after every step.

    Args:
        referee: Stepwise referee, which the callback updates.

    Attributes:
        record: Recorded contacts and states.
    """

    def __init__(self, referee: Referee) -> None:
        self._referee, self.record = referee, RefereeRecord([], [])

    def on_step(self, episode: Episode) -> None:
        self._referee.update(episode.contacts)
        self.record.contacts.append(episode.contacts)
        self.record.referee_states.append(self._referee.get_state())

    def on_end(self, episode: Episode) -> None:
        assert self._referee.status == episode.status


class ComparisonResult(NamedTuple):
    """Result of the comparison of both implementations of the referee in some episodes.

    Attributes:
        statuses: Outcome of each episode as bits of `EpisodeStatus`.
        n_compared: Number of compared pairs of referee states.
        differences: Message on each pair of states that differ.
    """

    statuses: list[int]
    n_compared: int
    differences: list[str]


class RefereeComparator:
    """Comparator of both implementations of the referee on simulated episodes, in one process.

    Args:
        args: Options of the script.
    """

    def __init__(self, args: Args) -> None:
        self._args, self._data = args, args.open_dataset()
        self._receiver = receivers.make(args.receiver, self._data, setup=args.setup)
        self._givers = {name: givers.make(name, self._data, setup=args.setup) for name in args.givers}
        self._episode = Episode(args.physics)

    def compare(self, tasks: Sequence[tuple[str, int]]) -> ComparisonResult:
        """Simulate episodes and compare both implementations of the referee on their contacts.

        Args:
            tasks: Name of the giver and scene number of each episode.
        """
        records = [self._simulate(*task) for task in tasks]
        compared, wrong = 0, []
        for segment in self._args.segments:
            for number, step, found, expected in self._judge_segments(records, segment):
                compared += 1
                if found != expected:
                    wrong.append(f"{tasks[number]}, step {step}, {segment} at once: {found}, not {expected}")
        return ComparisonResult([record.referee_states[-1].status for record in records], compared, wrong)

    def _simulate(self, giver: str, scene: int) -> RefereeRecord:
        recorder = RefereeRecorder(Referee(self._episode.config.protocol))
        self._episode.reset(self._data.load_scene(scene))
        run_episode(self._episode, self._receiver, self._givers[giver], seed=0, callbacks=[recorder])
        return recorder.record

    def _judge_segments(
        self, records: Sequence[RefereeRecord], most: int
    ) -> list[tuple[int, int, RefereeState, RefereeState]]:
        """Return episode index, last step and referee states (vectorized, stepwise) by segment."""
        rules = self._episode.config.protocol
        arrays = [ContactBatch.from_contacts(record.contacts, rules) for record in records]
        referee_states = [Referee(rules).get_state() for _ in records]
        found = []
        while running := [number for number, state in enumerate(referee_states) if not state.status]:
            starts = [referee_states[number].steps for number in running]
            steps = min(
                most, *(len(records[number].contacts) - first for number, first in zip(running, starts, strict=True))
            )
            parts = [
                [field[first : first + steps] for field in arrays[number]]
                for number, first in zip(running, starts, strict=True)
            ]
            contacts = ContactBatch(*(np.concatenate(fields, axis=1) for fields in zip(*parts, strict=True)))
            last, judged = judge_steps(
                RefereeStateBatch.from_states([referee_states[number] for number in running]), contacts, rules
            )
            for place, number in enumerate(running):
                referee_states[number] = judged.select(place)
                step = starts[place] + int(last[place])
                found.append(
                    (
                        number,
                        step,
                        _drop_idle_counters(referee_states[number]),
                        _drop_idle_counters(records[number].referee_states[step]),
                    )
                )
        return found


def _drop_idle_counters(state: RefereeState) -> RefereeState:
    """Return a referee state without counters that cannot influence the outcome any more."""
    state = state._replace(goal_steps=0) if state.status else state
    return state._replace(active_steps=0, passive_steps=0) if state.release_reason >= 0 else state


def main(args: Args) -> None:
    args = args.resolve_setup()
    data = args.open_dataset()
    scenes = data.list_scenes(args.setup, "train")
    tasks = [(giver, scene) for giver in args.givers for scene in scenes][: args.episodes]
    groups = [tasks[first : first + args.together] for first in range(0, len(tasks), args.together)]
    ends: Counter[int] = Counter()
    compared, wrong = 0, []
    for _, result in map_with_progress(
        lambda: RefereeComparator(args).compare, groups, "checking", PoolConfig(args.workers), True
    ):
        ends.update(result.statuses)
        compared += result.n_compared
        wrong += result.differences
    for line in wrong:
        print(line)
    counts = Counter(giver for giver, _ in tasks)
    print(
        f"{data.name}, {args.setup} train, {len(tasks)} episodes ({', '.join(f'{n} {g}' for g, n in counts.items())}), "
        f"receiver {args.receiver}, {args.physics} physics"
    )
    names = [(EpisodeStatus(status).name or "", str(count)) for status, count in ends.most_common()]
    print(format_table(["end", "episodes"], [list(row) for row in names]))
    print(f"arrays and referee compared {compared} times, {len(wrong)} differences")
    if wrong:
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Args))
