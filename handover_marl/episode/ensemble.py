"""Many episodes played at once by one process: what they do between physics stays their own."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from greenlet import getcurrent, greenlet

from handover_marl.config import WorldConfig
from handover_marl.episode.lockstep import Stretch, play_together
from handover_marl.sim.engines import make_worlds
from handover_marl.sim.world import World

_Result = TypeVar("_Result")


class Ensemble:
    """Worlds for some episodes, and turns for those who play them.

    Tasks given to `together` run one at a time, each until it wants physics; then all their worlds are simulated at
    once, and they go on. So whatever wraps an environment needs to know nothing of the others. What happens in an
    episode depends neither on the others nor on the threads.

    Args:
        physics: Kind of physics. Only worlds of an engine that can roll are simulated at once, others in turn.
        config: The world and the rules, the same for all.
        count: How many episodes.
        threads: Threads that simulate.
    """

    def __init__(self, physics: str, config: WorldConfig, count: int, threads: int) -> None:
        self._rules = config.protocol
        self._worlds = make_worlds(physics, config.physics, count, threads)
        self._threads = min(threads, count)
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None
        self._tasks: set[greenlet] = set()
        self._waiting: list[tuple[greenlet, int, Stretch]] = []

    def world(self, number: int) -> World:
        """The world of one of the episodes."""
        return self._worlds[number]

    def play(self, number: int, stretch: Stretch) -> None:
        """Play a stretch of an episode: at once, or within `together` when the others have got so far."""
        task = getcurrent()
        if task not in self._tasks:
            play_together([stretch], self._rules)
            return
        self._waiting.append((task, number, stretch))
        task.parent.switch()

    def together(self, tasks: Sequence[Callable[[], _Result]]) -> list[_Result]:
        """Run tasks that play episodes of this ensemble, each another one, and return what they return.

        Raises:
            Exception: What the first task raises that fails; those that have not ended by then are left off.
        """
        results: dict[int, _Result] = {}

        def run(order: int, task: Callable[[], _Result]) -> None:
            results[order] = task()

        self._waiting = []
        started = [greenlet(functools.partial(run, order, task)) for order, task in enumerate(tasks)]
        self._tasks = set(started)
        try:
            for one in started:
                one.switch()
            while self._waiting:
                waiting, self._waiting = self._waiting, []
                self._simulate([(number, stretch) for _, number, stretch in waiting])
                for one, _, _ in waiting:
                    one.switch()
        finally:
            self._tasks, self._waiting = set(), []
        return [results[order] for order in range(len(tasks))]

    def close(self) -> None:
        """Free all worlds."""
        if self._pool is not None:
            self._pool.shutdown()
        for world in self._worlds:
            world.close()

    def _simulate(self, stretches: list[tuple[int, Stretch]]) -> None:
        if self._pool is None:
            play_together([stretch for _, stretch in stretches], self._rules)
            return
        shares = [
            [stretch for number, stretch in stretches if number % self._threads == thread]
            for thread in range(self._threads)
        ]
        for _ in self._pool.map(lambda share: play_together(share, self._rules), shares):
            pass
