"""Learning environments: the views with features for observations and schemes for actions.

`LearningEnv` is a Gymnasium environment of one agent, `LearningParallelEnv` a PettingZoo one of both. Both draw
from chosen scenes, so that some can be kept for testing.
"""

from collections.abc import Iterable
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from pettingzoo import ParallelEnv

from handover_marl.errors import OptionError, ResetNeededError, SceneError
from handover_marl.handover_env import AGENTS, HandoverEnv
from handover_marl.learning.giver_schemes import GiverScheme
from handover_marl.learning.observing import make_features, n_features
from handover_marl.learning.schemes import make_scheme, scheme_size
from handover_marl.observations import Observation
from handover_marl.receivers import context_of
from handover_marl.views import SingleAgentEnv

Vector = npt.NDArray[np.float32]

#: What agents see and do unless told otherwise.
FEATURES = {"giver": "giver", "receiver": "receiver"}
SCHEMES = {"giver": "deviation", "receiver": "cartesian_delta"}
# Episodes that may end in a row before a scheme has asked for anything.
_PATIENCE = 100


class LearningEnv(gymnasium.Env[Any, Any], EzPickle):
    """One agent, the other frozen.

    A step lasts until the action scheme asks again, mostly one control period; rewards are added up meanwhile.

    Args:
        agent: The live one, "receiver" or "giver".
        partner: Name of the other one's policy.
        actions: Name of the action scheme; default: "cartesian_delta" for a receiver, "deviation" for a giver.
        observe: Name of the features; default: the agent's own.
        scenes: Only these scenes of the split.
        time_limit: Episodes are cut off after so long (s), to learn from more of them.
        options: As `HandoverEnv`.

    Raises:
        UnknownNameError: No such agent, policy, features or scheme.
        SceneError: A scene is not in the split.
    """

    metadata: dict[str, Any] = dict(HandoverEnv.metadata)

    def __init__(
        self,
        agent: str = "receiver",
        partner: str | None = None,
        actions: str | None = None,
        observe: str | None = None,
        scenes: Iterable[int] | None = None,
        time_limit: float = 13.0,
        **options: Any,
    ) -> None:
        EzPickle.__init__(self, agent, partner, actions, observe, scenes, time_limit, **options)
        self.env = SingleAgentEnv(agent, partner, **options)
        world = self.env.view.env
        self.agent = agent
        self.features_name, self.scheme_name = observe or FEATURES[agent], actions or SCHEMES[agent]
        self.scene_ids = chosen_scenes(scenes, world)
        self.render_mode, self.metadata = self.env.render_mode, self.env.metadata
        self.observation_space, self.action_space = learning_spaces(agent, self.features_name, self.scheme_name)
        context = context_of(world.dataset)
        self._features = make_features(agent, self.features_name, context)
        self._scheme = make_scheme(agent, self.scheme_name, context)
        self._time_limit = time_limit
        self._seen: Observation | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Start an episode and play it until the scheme asks; `options={"scene_id": n}` chooses the scene."""
        super().reset(seed=seed)
        for _ in range(_PATIENCE):
            # Its own seed for every episode, for partners that draw.
            chosen = {"scene_id": int(self.np_random.choice(self.scene_ids))} | (options or {})
            episode_seed = int(self.np_random.integers(2**31))
            self._seen, info = self.env.reset(seed=episode_seed, options=chosen)
            self._scheme.reset()
            _, ended, timed_out, info = self._until_asked(0.0, False, False, info)
            if not (ended or timed_out):
                return self._features(self._seen), info
        raise OptionError(
            f"in {_PATIENCE} episodes in a row nothing was asked of the {self.agent} before the end; choose "
            "another partner or action scheme"
        )

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Act until the scheme asks again or the episode ends."""
        if self._seen is None:
            raise ResetNeededError("no episode is running; call reset() before step()")
        self._scheme.decide(action)
        reward, ended, timed_out, info = self._once()
        reward, ended, timed_out, info = self._until_asked(reward, ended, timed_out, info)
        return self._features(self._seen), reward, ended, timed_out, info

    def outputs_of(self, action: Vector) -> Vector:
        """(size,) outputs that come nearest to a giver's action (8,) now, to learn from other givers.

        Raises:
            OptionError: The action scheme cannot say.
        """
        if not isinstance(self._scheme, GiverScheme):
            raise OptionError(f"action scheme {self.scheme_name!r} cannot imitate")
        return np.asarray(self._scheme.outputs(action, self.observed), dtype=np.float32)

    def render(self) -> Any:
        """As `HandoverEnv.render`."""
        return self.env.render()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _until_asked(
        self, reward: float, ended: bool, timed_out: bool, info: dict[str, Any]
    ) -> tuple[float, bool, bool, dict[str, Any]]:
        while not (ended or timed_out or self._scheme.asks(self.observed)):
            more, ended, timed_out, info = self._once()
            reward += more
        return reward, ended, timed_out, info

    def _once(self) -> tuple[float, bool, bool, dict[str, Any]]:
        action = self._scheme.action(self.observed)
        self._seen, reward, ended, timed_out, info = self.env.step(action)
        late = float(self._seen["time"][0]) >= self._time_limit
        return reward, ended, timed_out or (late and not ended), info

    @property
    def observed(self) -> Observation:
        """What the agent saw last, before it was made features of."""
        if self._seen is None:
            raise ResetNeededError("no episode is running; call reset() before step()")
        return self._seen


class LearningParallelEnv(ParallelEnv, EzPickle):  # type: ignore[misc]
    """Both agents, with features and action schemes.

    Args:
        actions: Name of each agent's action scheme; one that asks only now and then keeps its last outputs.
        observe: Name of each agent's features.
        scenes: Only these scenes of the split.
        time_limit: Episodes are cut off after so long (s), to learn from more of them.
        options: As `HandoverEnv`.

    Raises:
        UnknownNameError: No such features or scheme.
        SceneError: A scene is not in the split.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_learning_v0"}

    def __init__(
        self,
        actions: dict[str, str] | None = None,
        observe: dict[str, str] | None = None,
        scenes: Iterable[int] | None = None,
        time_limit: float = 13.0,
        **options: Any,
    ) -> None:
        EzPickle.__init__(self, actions, observe, scenes, time_limit, **options)
        self._time_limit = time_limit
        self.env = HandoverEnv(**options)
        self.possible_agents = list(AGENTS)
        self.scene_ids = chosen_scenes(scenes, self.env)
        self.render_mode = self.env.render_mode
        self.features_names, self.scheme_names = FEATURES | (observe or {}), SCHEMES | (actions or {})
        context = context_of(self.env.dataset)
        self._features = {agent: make_features(agent, self.features_names[agent], context) for agent in AGENTS}
        self._schemes = {agent: make_scheme(agent, self.scheme_names[agent], context) for agent in AGENTS}
        self._spaces = {
            agent: learning_spaces(agent, self.features_names[agent], self.scheme_names[agent]) for agent in AGENTS
        }
        self._seen: dict[str, Observation] = {}
        self._cut_off = False
        self._rng: np.random.Generator | None = None

    @property
    def agents(self) -> list[str]:
        """Both while an episode runs."""
        return [] if self._cut_off else self.env.agents

    def observation_space(self, agent: str) -> spaces.Box:
        """The agent's features."""
        return self._spaces[agent][0]

    def action_space(self, agent: str) -> spaces.Box:
        """The outputs that its scheme takes."""
        return self._spaces[agent][1]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Vector], dict[str, dict[str, Any]]]:
        """Start an episode; `options={"scene_id": n}` chooses the scene."""
        if seed is not None or self._rng is None:
            self._rng, _ = seeding.np_random(seed)
        chosen = {"scene_id": int(self._rng.choice(self.scene_ids))} | (options or {})
        self._seen, infos = self.env.reset(int(self._rng.integers(2**31)), chosen)
        self._cut_off = False
        for scheme in self._schemes.values():
            scheme.reset()
        return self._observed(), infos

    def step(
        self, actions: dict[str, Vector]
    ) -> tuple[dict[str, Vector], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Let both agents act for one control period."""
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        for agent, scheme in self._schemes.items():
            if scheme.asks(self._seen[agent]):
                scheme.decide(actions[agent])
        self._seen, rewards, ended, timed_out, infos = self.env.step(
            {agent: scheme.action(self._seen[agent]) for agent, scheme in self._schemes.items()}
        )
        if self.env.agents and float(self._seen[AGENTS[0]]["time"][0]) >= self._time_limit:
            self._cut_off, timed_out = True, dict.fromkeys(AGENTS, True)
        return self._observed(), rewards, ended, timed_out, infos

    def render(self) -> Any:
        """As `HandoverEnv.render`."""
        return self.env.render()

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _observed(self) -> dict[str, Vector]:
        return {agent: self._features[agent](self._seen[agent]) for agent in AGENTS}


def learning_spaces(agent: str, features_name: str, scheme_name: str) -> tuple[spaces.Box, spaces.Box]:
    """Spaces of an agent's features and outputs."""
    size = scheme_size(agent, scheme_name)
    seen = spaces.Box(-np.inf, np.inf, (n_features(agent, features_name),), np.float32)
    return seen, spaces.Box(-1.0, 1.0, (size,), np.float32)


def chosen_scenes(scenes: Iterable[int] | None, world: HandoverEnv) -> tuple[int, ...]:
    """These scenes, or all of the environment's split.

    Raises:
        SceneError: There is none, or one is not in the split.
    """
    if scenes is None:
        return world.scene_ids
    chosen = tuple(scenes)
    foreign = [scene for scene in chosen if scene not in world.scene_ids]
    if foreign or not chosen:
        raise SceneError(f"scenes {foreign[:5]} are not in {world.setup} {world.split}; env.scene_ids lists them")
    return chosen
