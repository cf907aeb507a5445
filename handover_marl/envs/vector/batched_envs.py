"""Handover environments whose episodes are simulated together as arrays."""

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from handover_marl.datasets.dataset import Scene
from handover_marl.envs.agents import GIVER, RECEIVER
from handover_marl.envs.handover_env import HandoverEnv, draw_seeds
from handover_marl.envs.vector.env_result import EnvResult
from handover_marl.envs.vector.reward_sums import RewardSums
from handover_marl.envs.wrappers.control_agent import FixedPartnerEnv
from handover_marl.envs.wrappers.encode import MAX_EPISODES_WITHOUT_OUTPUTS, EncodedEnv, make_no_outputs_error
from handover_marl.envs.wrappers.wrapper import ByAgent, WrappableEnv, list_wrappers
from handover_marl.episode.episode_batch import EpisodeBatch
from handover_marl.episode.loop import derive_giver_seed, derive_receiver_seed
from handover_marl.episode.observations import Observation, select_receiver_observation
from handover_marl.episode.referee import EpisodeStatus
from handover_marl.episode.spaces import has_camera
from handover_marl.episode.warp_sensors import WarpSensors
from handover_marl.geometry.arrays import AnyArray, AnyIndices, Indices, to_numpy
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.encodings.action_scheme import ArrayScheme
from handover_marl.learning.encodings.features import ArrayFeatures
from handover_marl.learning.encodings.registry import make_array_features, make_array_scheme
from handover_marl.learning.policy_files import OBSERVATION
from handover_marl.policies.batch import PolicyBatch, make_policy_batch
from handover_marl.simulation.engines import BatchBackend

_NONE = -1


class EncodedEpisodeBatch:
    """Batch of episodes of one configuration, with their rewards, partner, features and action schemes.

    An episode runs as in a single environment with the wrappers `control_agent` and `encode`. "Outputs" are the numbers
    from which an action scheme computes actions. The argument `rows` (r,) of methods has indices of episodes. The
    attribute `arrays` makes all arrays: NumPy arrays, or PyTorch tensors on the simulation's device.

    Args:
        template: Single environment of the configuration, with its wrappers; it is not simulated.
        count: Number of episodes.
        backend: Engine and device of the simulation.
    """

    def __init__(self, template: WrappableEnv, count: int, backend: BatchBackend) -> None:
        base: HandoverEnv = template.unwrapped
        self._base = base
        config = base.config
        self._agents = list(template.possible_agents)
        self._episodes = EpisodeBatch(config.world_config, count, backend)
        arrays = self.arrays = self._episodes.arrays
        self._rewards = RewardSums(config, self._episodes, count)
        self._cycles = arrays.zeros(count, "int64")
        self._terminated, self._truncated = arrays.zeros(count, "bool"), arrays.zeros(count, "bool")
        space = base.action_space(GIVER)
        self._giver_limits = arrays.asarray(space.low), arrays.asarray(space.high)
        self._partner: PolicyBatch | None = None
        self._partner_agent = GIVER if self._agents == [RECEIVER] else RECEIVER
        for env in list_wrappers(template):
            if isinstance(env, FixedPartnerEnv):
                self._partner = make_policy_batch(
                    env.reference, base.dataset, config.world_config, config.setup, count, arrays
                )
        self._features: dict[str, ArrayFeatures] = {}
        self._schemes: dict[str, ArrayScheme] = {}
        if isinstance(template, EncodedEnv):
            context = base.policy_context
            selector = LowestCostGraspSelector(context, count, arrays)
            for agent, (features, scheme) in template.choices.items():
                if features != OBSERVATION:
                    self._features[agent] = make_array_features(agent, features, context, selector, count, arrays)
                self._schemes[agent] = make_array_scheme(agent, scheme, context, selector, count, arrays)
        self._camera: WarpSensors | None = None
        is_camera_used = RECEIVER not in self._features or self._features[RECEIVER].uses_camera
        if has_camera(config.obs_mode) and RECEIVER in self._agents and is_camera_used:
            self._camera = WarpSensors(config.obs_mode, config.sensors, config.world_config.physics, count, arrays)

    def start(self, row: int, scene: Scene, seed: int | None, robot_seed: int, camera_seed: int) -> None:
        """Start the episode `row` in a scene.

        The seed of the partner is derived from the run seed `seed`; `draw_seeds` returns `robot_seed` and
        `camera_seed`.
        """
        episodes, rows = self._episodes, self.arrays.asarray([row])
        episodes.reset(row, scene, robot_seed)
        for scheme in self._schemes.values():
            scheme.reset(row)
        for features in self._features.values():
            features.reset(row)
        if self._camera is not None:
            self._camera.reset(row, scene.assets, camera_seed)
        episodes.update_state(rows)
        if self._partner is not None:
            self._partner.reset(row, self._derive_partner_seed(seed, scene, rows), scene.info.object_names)
        self._cycles[row] = 0
        self._terminated[row] = self._truncated[row] = False
        self._rewards.start(row)

    def clear_rewards(self, rows: AnyIndices) -> None:
        """Set the sums of rewards and reward terms of the episodes `rows` to 0; each `advance` adds to the sums."""
        self._rewards.clear(rows)

    def have_ended(self, rows: AnyIndices) -> AnyArray:
        """Return for each of the episodes `rows` whether it has terminated or was truncated, (r,)."""
        return self._terminated[rows] | self._truncated[rows]

    def find_rows_needing_no_outputs(self, rows: AnyIndices) -> AnyIndices:
        """Return those `rows` whose running episode needs no outputs now; none with two agents or without a scheme."""
        if len(self._agents) > 1 or not self._schemes:
            return rows[:0]
        (agent,) = self._agents
        running = rows[~self.have_ended(rows)]
        return running[~self._schemes[agent].needs_outputs(running, self._select_observation(agent, running))]

    def set_outputs(self, rows: AnyIndices, outputs: ByAgent) -> None:
        """Pass outputs (r, ...) by agent to the action schemes, in those of the episodes `rows` that need them now."""
        for agent, scheme in self._schemes.items():
            needs = scheme.needs_outputs(rows, self._select_observation(agent, rows))
            scheme.set_outputs(rows[needs], outputs[agent][needs])

    def advance(self, rows: AnyIndices, actions: ByAgent) -> None:
        """Simulate one control period of the running episodes `rows` with actions (r, ...) by agent.

        For agents with an action scheme, the scheme computes the actions, and `actions` is ignored.
        """
        config, episodes, actions = self._base.config, self._episodes, dict(actions)
        for agent, scheme in self._schemes.items():
            actions[agent] = scheme.compute_actions(rows, self._select_observation(agent, rows))
        actions = self._simulate(rows, actions, config.control_steps)
        episodes.update_state(rows)
        self._cycles[rows] += 1
        status, timeout = episodes.referees.status[rows], int(EpisodeStatus.TIMEOUT)
        terminated = (status & ~timeout) != 0
        truncated = (status & timeout) != 0
        if config.max_cycles is not None:
            truncated |= (self._cycles[rows] >= config.max_cycles) & ~terminated
        self._terminated[rows], self._truncated[rows] = terminated, truncated
        self._rewards.add(rows, actions, terminated, truncated)

    def _simulate(self, rows: AnyIndices, actions: ByAgent, steps: int) -> ByAgent:
        """Simulate `steps` physics steps, or fewer where an episode ends; the partner has its own control period.

        Returns the actions (r, ...) of both agents at the start of these steps, the giver's clipped to its bounds.
        """
        episodes, xp, (low, high) = self._episodes, self.arrays.xp, self._giver_limits
        agent = self._partner_agent
        observe = functools.partial(self._select_observation, agent)
        first: ByAgent | None = None
        ends = episodes.referees.steps[rows] + steps
        while len(rows):
            until = ends
            if self._partner is not None:
                actions[agent], next_steps = self._partner.act(rows, observe, episodes.referees.steps[rows])
                until = xp.minimum(ends, next_steps)
            # For NumPy several times as fast as `xp.clip`.
            actions[GIVER] = xp.minimum(xp.maximum(actions[GIVER], low), high)
            first = first or dict(actions)
            lengths = until - episodes.referees.steps[rows]
            for length in np.unique(to_numpy(lengths)).tolist():
                group = xp.nonzero(lengths == length)[0]
                episodes.advance(rows[group], actions[RECEIVER][group], length, actions[GIVER][group])
            # The control period of the others goes on: their partner's next decision is due.
            referees = episodes.referees
            left = xp.nonzero((referees.status[rows] == 0) & (referees.steps[rows] < ends))[0]
            rows, ends, actions = rows[left], ends[left], {name: values[left] for name, values in actions.items()}
            if len(rows):
                episodes.update_state(rows)
        return first or actions

    def make_result(self, rows: AnyIndices) -> EnvResult:
        """Return observations and infos of the episodes `rows`, and their rewards since the last `clear_rewards`."""
        result = EnvResult({}, {}, {}, {}, {})
        for agent in self._agents:
            observation = self._select_observation(agent, rows)
            if agent == RECEIVER and self._camera is not None:
                # Only here: neither built-in action schemes nor partners observe images.
                images = self._camera.observe(rows, observation, self._episodes.referees.steps[rows])
                observation = select_receiver_observation(observation, images, self._base.config.obs_mode)
            result.observations[agent] = (
                self._features[agent](rows, observation) if agent in self._features else observation
            )
            terms = self._rewards.make_infos(agent, rows)
            result.infos[agent] = {**self._episodes.make_infos(rows), **terms}
            if agent == RECEIVER:
                for key, matrix in self._base.calibration.items():
                    result.infos[agent][key] = self.arrays.asarray(np.repeat(matrix[None], len(rows), axis=0))
            result.rewards[agent] = self._rewards.totals[agent][rows]
            result.terminated[agent], result.truncated[agent] = self._terminated[rows], self._truncated[rows]
        return result

    def close(self) -> None:
        """Free the simulation."""
        self._episodes.close()
        if self._camera is not None:
            self._camera.close()

    def _derive_partner_seed(self, seed: int | None, scene: Scene, rows: AnyIndices) -> int:
        """Derive the partner's seed from the run seed; `rows` (1,) has the index of the observed episode."""
        if self._partner_agent == GIVER:
            return derive_giver_seed(seed, scene.info.scene_id)
        observation = self._select_observation(RECEIVER, rows)
        return derive_receiver_seed(seed, {key: to_numpy(values)[0] for key, values in observation.items()})

    def _select_observation(self, agent: str, rows: AnyIndices) -> Observation:
        if agent == GIVER:
            return self._episodes.select_giver_observation(rows)
        return self._episodes.select_state(rows)


class BatchedEnvGroup:
    """Environments of one configuration whose episodes are simulated together; see `EnvGroup`.

    Environment k behaves like a single environment with the wrappers `control_agent` and `encode` that draws the same
    scenes. Action schemes may need no outputs in the first control periods of an episode, for example while the robot
    waits. With `prefetches`, the group simulates these periods of the next episode together with the current episode,
    which is faster than to simulate them alone after a reset.

    Args:
        template: Single environment of the configuration, with its wrappers; it is not simulated.
        count: Number n of environments.
        prefetches: Whether to begin next episodes in advance, with one agent and an action scheme. A `reset` with a
            seed or options discards the next episode.
        load_scene: Function that loads a scene by its number.
        backend: Engine and device of the simulation.
    """

    def __init__(
        self,
        template: WrappableEnv,
        count: int,
        prefetches: bool,
        load_scene: Callable[[int], Scene],
        backend: BatchBackend,
    ) -> None:
        self._load_scene = load_scene
        self._base, self._agents = template.unwrapped, list(template.possible_agents)
        self._prefetches = prefetches and isinstance(template, EncodedEnv) and len(self._agents) == 1
        self._episodes = EncodedEpisodeBatch(template, count * (1 + self._prefetches), backend)
        self.arrays = self._episodes.arrays
        self._rngs, self._partner_rngs = ([seeding.np_random(None)[0] for _ in range(count)] for _ in range(2))
        # Number of the current episode of each environment, and of its next one, which has started.
        self._current, self._next = np.arange(count), np.full(count, _NONE)
        self._free = np.arange(count, 2 * count)
        # Copies of the random generators from before the next episode was drawn.
        self._rngs_before: list[tuple[np.random.Generator, np.random.Generator] | None] = [None] * count

    def reset(self, rows: Indices, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> EnvResult:
        """Start episodes, and simulate them until an action scheme needs outputs; see `EnvGroup.reset`."""
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            if seed is not None or options:
                self._discard_next(row)
            if seed is not None:
                self._rngs[row] = seeding.np_random(seed)[0]
                self._partner_rngs[row] = seeding.np_random(seed)[0]
        episodes, left = self._episodes, rows
        for _ in range(MAX_EPISODES_WITHOUT_OUTPUTS):
            for row in left.tolist():
                self._begin(row, options)
            current = self.arrays.asarray(self._current[left])
            while len(waiting := episodes.find_rows_needing_no_outputs(current)):
                episodes.clear_rewards(waiting)
                episodes.advance(waiting, {})
            left = left[to_numpy(episodes.have_ended(current))]
            if not len(left):
                current = self.arrays.asarray(self._current[rows])
                episodes.clear_rewards(current)
                return episodes.make_result(current)
        raise make_no_outputs_error(self._agents[0])

    def step(self, rows: Indices, actions: ByAgent) -> EnvResult:
        """Let the agents act for one control period, or until a scheme needs outputs; see `EnvGroup.step`."""
        episodes, current = self._episodes, self.arrays.asarray(self._current[rows])
        if self._prefetches:
            for row in rows[self._next[rows] == _NONE].tolist():
                self._start_next(row)
        episodes.set_outputs(current, actions)
        episodes.clear_rewards(current)
        active = current
        while len(active):
            coming = episodes.find_rows_needing_no_outputs(self.arrays.asarray(self._next[self._next != _NONE]))
            episodes.clear_rewards(coming)
            episodes.advance(self.arrays.xp.concat([active, coming]), actions)
            active = episodes.find_rows_needing_no_outputs(active)
        return episodes.make_result(current)

    def render(self) -> None:
        """Return None, because these environments have no `render_mode`."""

    def close(self) -> None:
        """Free the simulation."""
        self._episodes.close()

    def _begin(self, row: int, options: Mapping[str, Any] | None) -> None:
        """Make the next episode of environment `row` its current one, or start an episode if there is no next one."""
        if self._next[row] == _NONE:
            self._start(row, int(self._current[row]), options)
        else:
            self._free[row] = self._current[row]
            self._current[row] = self._next[row]
            self._next[row] = _NONE

    def _start_next(self, row: int) -> None:
        """Start the next episode of environment `row` beside its current one."""
        self._rngs_before[row] = copy.deepcopy((self._rngs[row], self._partner_rngs[row]))
        self._start(row, int(self._free[row]), None)
        self._next[row] = self._free[row]

    def _discard_next(self, row: int) -> None:
        """Forget the next episode of environment `row`, if there is one, as if its scene had not been drawn."""
        before = self._rngs_before[row]
        if self._next[row] != _NONE and before is not None:
            self._rngs[row], self._partner_rngs[row] = before
            self._next[row] = _NONE

    def _start(self, row: int, episode: int, options: Mapping[str, Any] | None) -> None:
        """Start an episode of environment `row` as episode `episode` of the simulation; `options` may set the scene."""
        rng = self._rngs[row]
        scene_id = self._base.choose_scene(options, rng)
        robot_seed, camera_seed = draw_seeds(rng, self._base.config.world_config)
        partner_seed = int(self._partner_rngs[row].integers(2**32))
        self._episodes.start(episode, self._load_scene(scene_id), partner_seed, robot_seed, camera_seed)
