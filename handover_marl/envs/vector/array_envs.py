"""Handover environments whose episodes are simulated together as arrays."""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from handover_marl.datasets.dataset import Scene
from handover_marl.envs.handover_env import draw_seeds
from handover_marl.envs.vector.array_episodes import ArrayEpisodes
from handover_marl.envs.vector.batch import EnvResult
from handover_marl.envs.wrappers.encode import MAX_EPISODES_WITHOUT_OUTPUTS, EncodedEnv, make_no_outputs_error
from handover_marl.envs.wrappers.wrapper import ByAgent, WrappableEnv
from handover_marl.geometry.arrays import Indices, to_numpy
from handover_marl.simulation.engines import BatchBackend

_NONE = -1


class ArrayEnvs:
    """Environments of one configuration whose episodes are simulated together; see `batch.Envs`.

    Environment k behaves like a single environment with the wrappers `control_agent` and `encode` that draws
    the same scenes. Action schemes may need no outputs in the first control periods of an episode,
    for example while the robot waits. These periods of the next episode are simulated together with
    the current episode, which is faster than simulating these periods alone after a reset.

    Args:
        template: Single environment of the configuration, with its wrappers; it is not simulated.
        count: Number n of environments.
        prefetch_episodes: Whether the next episodes may be simulated in advance, because `reset` gets no
            seed and no options after the end of an episode.
        load_scene: Function that loads a scene by its number.
        backend: Engine and device of the simulation.

    Attributes:
        arrays: Creator of the arrays that `reset` and `step` return.
    """

    def __init__(
        self,
        template: WrappableEnv,
        count: int,
        prefetch_episodes: bool,
        load_scene: Callable[[int], Scene],
        backend: BatchBackend,
    ) -> None:
        self._load_scene = load_scene
        self._base, self._agents = template.unwrapped, list(template.possible_agents)
        self._prefetches = prefetch_episodes and isinstance(template, EncodedEnv) and len(self._agents) == 1
        self._episodes = ArrayEpisodes(template, count * (1 + self._prefetches), backend)
        self.arrays = self._episodes.arrays
        self._rngs, self._partner_rngs = ([seeding.np_random(None)[0] for _ in range(count)] for _ in range(2))
        # Number of the current episode of each environment, and of its next one, which has started.
        self._current, self._next = np.arange(count), np.full(count, _NONE)
        self._free = np.arange(count, 2 * count)
        # Copies of the random generators from before the next episode was drawn.
        self._rngs_before: list[tuple[np.random.Generator, np.random.Generator] | None] = [None] * count

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes, and simulate them until an action scheme needs outputs; see `batch.Envs.reset`.

        Raises:
            OptionError: Many episodes in a row have ended before outputs were needed.
        """
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            if seed is not None or options:
                self._discard_next(row)
            if seed is not None:
                self._rngs[row], self._partner_rngs[row] = (seeding.np_random(seed)[0] for _ in range(2))
        left, episodes = rows, self._episodes
        for _ in range(MAX_EPISODES_WITHOUT_OUTPUTS):
            for row in left.tolist():
                if self._next[row] == _NONE:
                    self._start(row, int(self._current[row]), options)
                else:
                    self._current[row], self._free[row], self._next[row] = self._next[row], self._current[row], _NONE
            current = self.arrays.asarray(self._current[left])
            while len(waiting := episodes.find_without_outputs(current)):
                episodes.clear_rewards(waiting)
                episodes.advance(waiting, {})
            left = left[to_numpy(episodes.have_ended(current))]
            if not len(left):
                break
        else:
            raise make_no_outputs_error(self._agents[0])
        result = episodes.make_result(self.arrays.asarray(self._current[rows]))
        return result._replace(rewards={agent: self.arrays.zeros(len(rows)) for agent in self._agents})

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Let the agents act for one control period, or until an action scheme needs outputs; see `batch.Envs.step`."""
        episodes, current = self._episodes, self.arrays.asarray(self._current[rows])
        if self._prefetches:
            self._start_next(rows)
        episodes.set_outputs(current, actions)
        episodes.clear_rewards(current)
        active = current
        while len(active):
            coming = episodes.find_without_outputs(self.arrays.asarray(self._next[self._next != _NONE]))
            episodes.clear_rewards(coming)
            episodes.advance(self.arrays.xp.concat([active, coming]), actions)
            active = episodes.find_without_outputs(active)
        return episodes.make_result(current)

    def render(self) -> None:
        """Return None, because these environments have no `render_mode`."""

    def close(self) -> None:
        """Free the simulation."""
        self._episodes.close()

    def _start(self, row: int, episode: int, options: Mapping[str, Any] | None) -> None:
        """Start the episode `episode` for the environment `row`, in the scene of `options` or a drawn one."""
        rng = self._rngs[row]
        scene_id = self._base.choose_scene(options, rng)
        robot_seed, camera_seed = draw_seeds(rng, self._base.config.world_config)
        partner_seed = int(self._partner_rngs[row].integers(2**32))
        self._episodes.start(episode, self._load_scene(scene_id), partner_seed, robot_seed, camera_seed)

    def _start_next(self, rows: Indices) -> None:
        """Start the next episode of those of the environments `rows` that have no next episode yet."""
        for row in rows[self._next[rows] == _NONE].tolist():
            self._rngs_before[row] = copy.deepcopy((self._rngs[row], self._partner_rngs[row]))
            self._start(row, int(self._free[row]), None)
            self._next[row] = self._free[row]

    def _discard_next(self, row: int) -> None:
        """Forget the next episode of the environment `row`, as if its scene had not been drawn."""
        before = self._rngs_before[row]
        if self._next[row] != _NONE and before is not None:
            self._rngs[row], self._partner_rngs[row] = before
            self._next[row] = _NONE
