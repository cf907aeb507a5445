"""Simulation of many episodes in lockstep: batched physics, protocol rules on arrays."""

import functools
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from handover_marl.config import ProtocolConfig, WorldConfig
from handover_marl.episode.referee import EpisodeStatus, Referee, RefereeState, ReleaseReason
from handover_marl.simulation.contacts import ContactBatch
from handover_marl.simulation.engines import make_worlds
from handover_marl.simulation.world import BatchWorld, World

if TYPE_CHECKING:
    from greenlet import greenlet

Flags = npt.NDArray[np.bool_]
Counts = npt.NDArray[np.int_]
_Result = TypeVar("_Result")

_ACTIVE, _PASSIVE = tuple(ReleaseReason).index(ReleaseReason.ACTIVE), tuple(ReleaseReason).index(ReleaseReason.PASSIVE)
# Steps of one rollout. Steps after a release or an episode's end are simulated in vain.
_ROLLOUT_STEPS = 100
# Worlds of one rollout. The sensor readings of more worlds do not fit into the processor's cache.
_ROLLOUT_WORLDS = 32


@dataclass(eq=False)
class RolloutSegment:
    """Physics steps of one episode during which the robot's joint targets stay the same.

    Attributes:
        world: World to simulate, with the reference motion of these steps set.
        referee: Referee of the episode.
        robot_target: Nine joint targets of the Panda (rad, m), float32 values.
        remaining_steps: Number of physics steps left to simulate, at most the rows left in the
            reference motion.
        simulated_steps: Number of steps simulated so far.
    """

    world: BatchWorld
    referee: Referee
    robot_target: list[float]
    remaining_steps: int
    simulated_steps: int = 0

    @property
    def is_finished(self) -> bool:
        """Whether no steps are left to simulate or the episode has ended."""
        return self.remaining_steps == 0 or bool(self.referee.status)


def simulate_segments(segments: Iterable[RolloutSegment], rules: ProtocolConfig) -> None:
    """Simulate the segments of several episodes to their last steps, or to the episodes' ends.

    Raises:
        SimulationError: The engine failed; the states of all worlds are invalid.
    """
    running = [segment for segment in segments if not segment.is_finished]
    while running:
        # Preparing a sleeping world may wake it, which changes its batch.
        _prepare([segment for segment in running if segment.world.is_asleep])
        batches: dict[object, list[tuple[int, RolloutSegment]]] = {}
        for segment in running:
            key, place = segment.world.batch_key
            batches.setdefault(key, []).append((place, segment))
        # Small batches are prepared together; a large one is prepared in its own rollouts.
        small = [segment for batch in batches.values() if len(batch) < _ROLLOUT_WORLDS for _, segment in batch]
        _prepare([segment for segment in small if not segment.world.is_asleep])
        for batch in batches.values():
            ordered = [segment for _, segment in sorted(batch, key=lambda entry: entry[0])]
            for first in range(0, len(ordered), _ROLLOUT_WORLDS):
                _simulate_rollout(ordered[first : first + _ROLLOUT_WORLDS], rules)
        running = [segment for segment in running if not segment.is_finished]


def _prepare(segments: list[RolloutSegment]) -> None:
    for first in range(0, len(segments), _ROLLOUT_WORLDS):
        part = segments[first : first + _ROLLOUT_WORLDS]
        worlds = [segment.world for segment in part]
        worlds[0].prepare_rollout(worlds, [segment.robot_target for segment in part])


def _simulate_rollout(segments: list[RolloutSegment], rules: ProtocolConfig) -> None:
    limits = (min(segment.remaining_steps, segment.world.max_rollout_steps) for segment in segments)
    steps = min(_ROLLOUT_STEPS, *limits)
    worlds = [segment.world for segment in segments]
    rollout = worlds[0].simulate_rollout(worlds, [segment.robot_target for segment in segments], steps, rules)
    before = RefereeStateBatch.from_states([segment.referee.get_state() for segment in segments])
    last, after = judge_steps(before, rollout.contacts, rules)
    for number, segment in enumerate(segments):
        taken = int(last[number]) + 1
        if taken < steps:
            rollout.truncate(number, taken)
        segment.remaining_steps -= taken
        segment.simulated_steps += taken
        was_released = segment.referee.released
        segment.referee.restore(after.select(number))
        if segment.referee.released and not was_released:
            segment.world.release_target()


class RefereeStateBatch(NamedTuple):
    """States of the referees of n episodes: the fields of `RefereeState` as arrays (n,)."""

    status: Counts
    steps: Counts
    release: Counts
    release_step: Counts
    active_steps: Counts
    passive_steps: Counts
    goal_steps: Counts

    @classmethod
    def from_states(cls, states: list[RefereeState]) -> "RefereeStateBatch":
        """Stack the referee states of n episodes."""
        return cls(*np.array(states, dtype=np.int_).reshape(-1, len(RefereeState._fields)).T)

    def select(self, number: int) -> RefereeState:
        """Return the referee state of the episode with this index."""
        return RefereeState(*(int(array[number]) for array in self))


def judge_steps(
    before: RefereeStateBatch, contacts: ContactBatch, config: ProtocolConfig
) -> tuple[Counts, RefereeStateBatch]:
    """Apply release and end rules to k steps of n episodes, up to the first release or end of each.

    The states are the same as with `Referee.update` after every step, but there is no loop over steps.

    Args:
        before: Referee states before these steps; all episodes are running.
        contacts: Contacts of the steps. Steps after a release or an episode's end are ignored.
        config: Thresholds of the protocol's rules.

    Returns:
        Index (n,) from 0 of the last step that was applied in each episode, and the referee
        states after that step.
    """
    n_steps, n_episodes = contacts.robot_touches_hand.shape
    number = np.arange(n_steps)[:, None]
    left, right = contacts.in_grasp_region[..., 0], contacts.in_grasp_region[..., 1]
    active = _count_consecutive(contacts.robot_touches_object & left & right, before.active_steps)
    passive = _count_consecutive(contacts.robot_touches_object & ~(left | right), before.passive_steps)
    held = before.release < 0
    releases = held & ((active >= config.release_steps) | (passive >= config.release_steps))
    released = ~held | np.logical_or.accumulate(releases, axis=0)
    both = contacts.fingers_touch.all(axis=-1)
    dropped = released & ~both & (contacts.object_supported | (contacts.object_height < config.drop_height))
    fails = contacts.robot_touches_hand | dropped
    away = contacts.gripper_position - np.array(config.goal_center)
    near = np.sqrt((away**2).sum(axis=-1)) < config.goal_radius
    goal = _count_consecutive(released & ~fails & near & both, before.goal_steps)
    succeeds = goal >= config.success_steps
    late = before.steps + number + 1 >= config.horizon_steps
    stops = releases | fails | succeeds | late
    last = np.where(stops.any(axis=0), stops.argmax(axis=0), n_steps - 1)
    now = (last, np.arange(n_episodes))
    status = (
        int(EpisodeStatus.HUMAN_CONTACT) * contacts.robot_touches_hand[now]
        + int(EpisodeStatus.OBJECT_DROP) * dropped[now]
        + int(EpisodeStatus.TIMEOUT) * late[now]
    )
    steps = before.steps + last + 1
    reason = np.where(active[now] >= config.release_steps, _ACTIVE, _PASSIVE)
    return last, RefereeStateBatch(
        status=np.where(succeeds[now], int(EpisodeStatus.SUCCESS), status),
        steps=steps,
        release=np.where(releases[now], reason, before.release),
        release_step=np.where(releases[now], steps, before.release_step),
        active_steps=np.where(held, active[now], before.active_steps),
        passive_steps=np.where(held, passive[now], before.passive_steps),
        goal_steps=goal[now],
    )


def _count_consecutive(condition: Flags, before: Counts) -> Counts:
    """Count, after each step, for how many consecutive steps a condition has held.

    Args:
        condition: Truth value (k, n) of the condition in k steps of n episodes.
        before: Count (n,) before the first step.

    Returns:
        Counts (k, n).
    """
    number = np.arange(len(condition))[:, None]
    missed = np.maximum.accumulate(np.where(condition, -1, number), axis=0)
    return np.where(missed < 0, before + number + 1, number - missed)


class LockstepScheduler:
    """Cooperative scheduler that simulates the worlds of several episodes together.

    `run_together` runs tasks one at a time, each in a greenlet, until all of them wait for physics.
    Then it simulates all their worlds as batches and continues the tasks. The outcome of an
    episode depends neither on the other episodes nor on the number of threads.

    Args:
        physics: Kind of physics. Worlds of engines without batches are simulated one after another.
        config: World and rules of all episodes.
        count: Number of episodes.
        threads: Number of threads that simulate.
    """

    def __init__(self, physics: str, config: WorldConfig, count: int, threads: int) -> None:
        self._rules = config.protocol
        self._worlds = make_worlds(physics, config.physics, count, threads)
        self._threads = min(threads, count)
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None
        self._tasks: set[greenlet] = set()
        self._waiting: list[tuple[greenlet, int, RolloutSegment]] = []

    def get_world(self, number: int) -> World:
        """Return the simulated world of the episode with this index."""
        return self._worlds[number]

    def simulate(self, number: int, segment: RolloutSegment) -> None:
        """Simulate a segment of one episode; `run_together` batches it with the segments of other tasks."""
        # greenlet is an optional dependency, and single episodes do not need it.
        from greenlet import getcurrent

        task = getcurrent()
        if task not in self._tasks:
            simulate_segments([segment], self._rules)
            return
        self._waiting.append((task, number, segment))
        task.parent.switch()

    def run_together(self, tasks: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Run tasks, each of which advances another episode, in lockstep; return their results.

        Raises:
            Exception: The first exception that a task raises; unfinished tasks are abandoned.
        """
        from greenlet import greenlet

        results: dict[int, _Result] = {}

        def run(order: int, task: Callable[[], _Result]) -> None:
            results[order] = task()

        self._waiting = []
        started = [greenlet(functools.partial(run, order, task)) for order, task in enumerate(tasks)]
        self._tasks = set(started)
        try:
            for task in started:
                task.switch()
            while self._waiting:
                waiting, self._waiting = self._waiting, []
                self._simulate_all([(number, segment) for _, number, segment in waiting])
                for task, _, _ in waiting:
                    task.switch()
        finally:
            self._tasks, self._waiting = set(), []
        return [results[order] for order in range(len(tasks))]

    def close(self) -> None:
        """Free the simulated worlds of all episodes."""
        if self._pool is not None:
            self._pool.shutdown()
        for world in self._worlds:
            world.close()

    def _simulate_all(self, segments: list[tuple[int, RolloutSegment]]) -> None:
        if self._pool is None:
            simulate_segments([segment for _, segment in segments], self._rules)
            return
        shares = [
            [segment for number, segment in segments if number % self._threads == thread]
            for thread in range(self._threads)
        ]
        for _ in self._pool.map(lambda share: simulate_segments(share, self._rules), shares):
            pass
