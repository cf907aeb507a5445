"""Wrapper that replaces observations by features, if wanted, and actions by network outputs."""

import copy
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle

from handover_marl.envs.agents import GIVER, RECEIVER
from handover_marl.envs.handover_env import HandoverEnv
from handover_marl.envs.wrappers.wrapper import (
    REWARD_PREFIX,
    Api,
    ByAgent,
    ParallelStep,
    ParallelWrapper,
    WrappableEnv,
    convert_api,
)
from handover_marl.episode.observations import Observation, add_episode_axis
from handover_marl.episode.spaces import check_vector, has_state
from handover_marl.errors import OptionError, ResetNeededError
from handover_marl.geometry.arrays import ONLY_ROW
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.encodings.action_scheme import ArrayScheme, RawScheme
from handover_marl.learning.encodings.custom import FeaturesLike, SchemeLike, is_reference
from handover_marl.learning.encodings.features import ArrayFeatures
from handover_marl.learning.encodings.registry import make_array_features, make_array_scheme
from handover_marl.learning.policy_files import OBSERVATION

DEFAULT_FEATURES = {GIVER: "giver", RECEIVER: "receiver"}
DEFAULT_SCHEMES = {GIVER: "deviation", RECEIVER: "cartesian_delta"}
_SCHEMES_FROM_STATE = ("grasp_servo",)
#: Number of episodes in a row without a need of outputs after which an error is raised.
MAX_EPISODES_WITHOUT_OUTPUTS = 100
_VIDEO_ADVICE = (
    "images of single steps are no video in real time, since steps of this action scheme last several control periods; "
    "for a video, wrap the environment by pettingzoo.utils.wrappers.RecordVideoParallel before control_agent and encode"
)


class EncodedEnv(ParallelWrapper):
    """Wrapper whose observations are feature vectors and whose actions are network outputs, made by `encode`.

    The action scheme decodes outputs into actions. With one agent, a step lasts until the scheme needs outputs again,
    mostly one control period; rewards are summed over the step. If an episode ends before outputs are needed, `reset`
    starts another one. Rewards of the control steps that `reset` simulates are not returned. With two agents, a step is
    one control period, and outputs for a scheme that needs none are ignored. Features with memory are then updated in
    every control period; in evaluations, they are updated only when the policy decides.

    Attributes:
        choices: Pair of features and action scheme by agent, as given or by default.
    """

    metadata: dict[str, Any] = {**HandoverEnv.metadata, "name": "handover_encoded_v0"}

    def __init__(
        self,
        env: WrappableEnv,
        features: FeaturesLike | Mapping[str, FeaturesLike] | None = None,
        action_scheme: SchemeLike | Mapping[str, SchemeLike] | None = None,
    ) -> None:
        super().__init__(env)
        EzPickle.__init__(self, env, features, action_scheme)
        agents = self.possible_agents
        vectors = [agent for agent in agents if not isinstance(env.observation_space(agent), spaces.Dict)]
        if vectors:
            raise OptionError(f"observations of the {vectors[0]} are vectors already; encode once")
        chosen_features = _complete_choices("features", DEFAULT_FEATURES, features, agents)
        chosen_schemes = _complete_choices("action_scheme", DEFAULT_SCHEMES, action_scheme, agents)
        base = self.unwrapped
        if RECEIVER in agents:
            _check_state(base.config.obs_mode, chosen_features[RECEIVER], chosen_schemes[RECEIVER])
        self.choices = {agent: (chosen_features[agent], chosen_schemes[agent]) for agent in agents}
        self._features: dict[str, ArrayFeatures] = {}
        self._schemes: dict[str, ArrayScheme] = {}
        context = base.policy_context
        selector = LowestCostGraspSelector(context, 1)
        for agent in agents:
            if chosen_features[agent] != OBSERVATION:
                self._features[agent] = make_array_features(agent, chosen_features[agent], context, selector, 1)
            self._schemes[agent] = make_array_scheme(agent, chosen_schemes[agent], context, selector, 1)
        self._feature_spaces = {
            agent: spaces.Box(-np.inf, np.inf, (made.size,), np.float32) for agent, made in self._features.items()
        }
        self._output_spaces: dict[str, Any] = {
            agent: copy.deepcopy(env.action_space(agent))
            if isinstance(made, RawScheme)
            else spaces.Box(-1.0, 1.0, (made.size,), np.float32)
            for agent, made in self._schemes.items()
        }
        for agent, outputs in self._output_spaces.items():
            # Libraries that save spaces with a policy save the encoding with them.
            outputs.control_period = base.config.control_period
            features_name = self._features[agent].name if agent in self._features else OBSERVATION
            outputs.encoding = {"agent": agent, "features": features_name, "actions": self._schemes[agent].name}
            if agent == RECEIVER:
                outputs.encoding["obs_mode"] = base.config.obs_mode
        self._observations: dict[str, Observation] = {}
        self._has_skipped = self._has_ended = False

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of the agent's features, or of the observation if its features are "observation"."""
        space: spaces.Space[Any] = self._feature_spaces.get(agent) or self.env.observation_space(agent)
        return space

    def action_space(self, agent: str) -> spaces.Box:
        """Return the space of the network outputs that the agent's action scheme decodes.

        It is a box from -1 to 1; for the schemes `giver` and `receiver` it is the action space of the environment.
        """
        space: spaces.Box = self._output_spaces[agent]
        return space

    def _compute_features(self) -> ByAgent:
        """Return the features (m,) of the last observation by agent, or a copy of the observation without features."""
        # Copies, since callers may write into their observations and action schemes read them again.
        copies = {agent: {key: own[key].copy() for key in own} for agent, own in self._observations.items()}
        return {
            agent: self._features[agent](ONLY_ROW, add_episode_axis(own))[0] if agent in self._features else own
            for agent, own in copies.items()
        }

    def reset(self, seed: int | None = None, options: ByAgent | None = None) -> tuple[ByAgent, ByAgent]:
        """Start an episode; with one agent, simulate it until its action scheme needs outputs.

        Returns features and infos by agent. Arguments are as in `HandoverEnv.reset`.
        """
        for attempt in range(MAX_EPISODES_WITHOUT_OUTPUTS):
            self._observations, infos = self.env.reset(seed=seed if attempt == 0 else None, options=options)
            for scheme in self._schemes.values():
                scheme.reset(0)
            for features in self._features.values():
                features.reset(0)
            self._has_ended = False
            while self._can_skip():
                self._observations, _, _, _, infos = self._advance()
            if self.agents and not self._has_ended:
                for info in infos.values():
                    info.update({key: 0.0 for key in info if key.startswith(REWARD_PREFIX)})
                return self._compute_features(), infos
        raise make_no_outputs_error(self.possible_agents[0])

    def step(self, actions: dict[str, Any]) -> ParallelStep:
        """Let two agents act for one control period, or one agent until its scheme needs outputs or the episode ends.

        Args:
            actions: Outputs by agent, elements of the action spaces; ignored where a scheme needs none.

        Returns:
            Feature vectors, undiscounted sums of the rewards, terminations, truncations and infos by agent.

        Raises:
            ActionError: Outputs of an agent are missing or malformed.
            ResetNeededError: No episode is running.
        """
        if not (self.agents and self._observations):
            raise ResetNeededError("no episode is running; call reset() before step()")
        given = actions if isinstance(actions, Mapping) else {}
        outputs = {
            agent: check_vector(
                f"outputs of the {agent}", given.get(agent), self._schemes[agent].size, "inputs of its action scheme"
            )
            for agent in self.agents
        }
        for agent, scheme in self._schemes.items():
            if self._needs_outputs(agent):
                scheme.set_outputs(ONLY_ROW, outputs[agent][None])
        self._observations, rewards, terminations, truncations, infos = self._advance()
        while self._can_skip():
            self._has_skipped, before = True, infos
            self._observations, more, terminations, truncations, infos = self._advance()
            rewards = {agent: rewards[agent] + more[agent] for agent in rewards}
            for agent, info in infos.items():
                terms = [key for key in info if key.startswith(REWARD_PREFIX)]
                info.update({key: info[key] + before[agent][key] for key in terms})
        return self._compute_features(), rewards, terminations, truncations, infos

    def render(self) -> Any:
        """Return an RGB image (height, width, 3) in the mode "rgb_array", else None.

        Warns if steps have lasted several control periods, since a video with one image for each step is too short.
        """
        if self._has_skipped and self.render_mode == "rgb_array":
            warnings.warn(_VIDEO_ADVICE, stacklevel=2)
        return self.env.render()

    def _advance(self) -> ParallelStep:
        actions = {
            agent: scheme.compute_actions(ONLY_ROW, add_episode_axis(self._observations[agent]))[0]
            for agent, scheme in self._schemes.items()
        }
        step: ParallelStep = self.env.step(actions)
        # A wrapper inside may have ended an episode that goes on in the environment.
        self._has_ended = any(flag for ends in step[2:4] for flag in ends.values())
        return step

    def _needs_outputs(self, agent: str) -> bool:
        return bool(self._schemes[agent].needs_outputs(ONLY_ROW, add_episode_axis(self._observations[agent]))[0])

    def _can_skip(self) -> bool:
        """Return whether there is only one agent, and its running episode needs no outputs for the next step."""
        is_running = len(self.possible_agents) == 1 and bool(self.agents) and not self._has_ended
        return is_running and not self._needs_outputs(self.agents[0])


def encode(
    env: WrappableEnv,
    features: FeaturesLike | Mapping[str, FeaturesLike] | None = None,
    action_scheme: SchemeLike | Mapping[str, SchemeLike] | None = None,
    *,
    api: Api = "parallel",
) -> Any:
    """Return an environment whose observations are feature vectors and whose actions are outputs of a network.

    Outputs are in [-1, 1], except those of the action schemes `giver` and `receiver`, which are in physical units.

    Args:
        env: `handover_marl.parallel_env(...)`, or `control_agent(...)` of it.
        features: Name of built-in features; or user-defined features: a subclass of `FeatureExtractor`, a function
            with `declare_size`, or text `module:name`; or "observation" for unchanged observations, such as images. A
            mapping by agent if `env` has two agents. Default: "giver" for the giver and "receiver" for the receiver.
        action_scheme: Name of a built-in action scheme; or a user-defined scheme: a subclass of `ActionScheme`, a
            function with `declare_size`, or text `module:name`. A mapping by agent if `env` has two agents. Default:
            "deviation" for the giver and "cartesian_delta" for the receiver.
        api: "parallel" for a PettingZoo environment, "gymnasium" for a Gymnasium environment, which has one agent.

    Raises:
        UnknownNameError: There are no such features, no such scheme or API.
        OptionError: There is no such agent, observations are encoded already, one choice is given for two agents,
            features or a scheme need the state but the receiver does not observe it, or a user-defined one has no size.
        EncodingError: The constructor of user-defined features or of a user-defined scheme fails.
    """
    return convert_api(EncodedEnv(env, features, action_scheme), api)


def make_no_outputs_error(agent: str) -> OptionError:
    """Return the error for an agent whose action scheme needed no outputs in many episodes in a row."""
    return OptionError(
        f"no outputs of the {agent} were needed in {MAX_EPISODES_WITHOUT_OUTPUTS} episodes in a row; choose another "
        "partner or action scheme, or a larger max_cycles"
    )


def _complete_choices(argument: str, defaults: dict[str, str], choices: Any, agents: list[str]) -> dict[str, Any]:
    """Return the features or schemes of each of `agents`; agents that `choices` leaves out get those of `defaults`.

    `choices` is a dict by agent, or the choice for the only agent; error messages call it `argument`.
    """
    if not isinstance(choices, Mapping):
        if choices is not None and len(agents) != 1:
            raise OptionError(
                f"{argument} must be a dict by agent for {len(agents)} agents, got {choices!r}; for one of them, call "
                "control_agent first"
            )
        choices = {} if choices is None else {agents[0]: choices}
    unknown = sorted(map(str, choices.keys() - set(agents)))
    if unknown:
        raise OptionError(f"{argument} must be for {' and '.join(agents)}, got a choice for {unknown[0]!r}")
    return {agent: choices.get(agent, defaults[agent]) for agent in agents}


def _check_state(obs_mode: str, features: Any, scheme: Any) -> None:
    """Raise OptionError if the receiver's features or scheme need the state, but `obs_mode` does not include it.

    User-defined features and user-defined schemes may use the data of cameras alone.
    """
    is_built_in = isinstance(features, str) and features != OBSERVATION and not is_reference(features)
    uses_state = is_built_in or scheme in _SCHEMES_FROM_STATE
    if uses_state and not has_state(obs_mode):
        raise OptionError(
            f"obs_mode must include the state that features are computed from, got {obs_mode!r}; take 'state' or "
            f"'state+{obs_mode}', or write features of the camera data"
        )
