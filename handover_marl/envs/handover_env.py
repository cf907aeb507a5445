"""Human-to-robot handover as a two-agent PettingZoo environment."""

import os
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import logger, spaces
from gymnasium.utils import EzPickle, seeding
from pettingzoo import ParallelEnv

from handover_marl.config import TIME_STEP, CameraConfig, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import choose_scenes
from handover_marl.envs.agents import AGENTS, GIVER, RECEIVER
from handover_marl.envs.config import RENDER_MODES, EnvConfig
from handover_marl.envs.custom_rewards import RewardSource
from handover_marl.envs.rewards import StepData
from handover_marl.envs.transition import Transition, TransitionRecorder
from handover_marl.episode.camera_observations import CameraCapture
from handover_marl.episode.episode import Episode
from handover_marl.episode.loop import EpisodeAgent, EpisodePolicy, derive_seed
from handover_marl.episode.observations import (
    Observation,
    add_episode_axis,
    giver_observation_space,
    receiver_observation_space,
    select_receiver_observation,
    state_space,
)
from handover_marl.episode.referee import RELEASE_REASONS, EpisodeStatus
from handover_marl.episode.spaces import (
    check_giver_action,
    check_receiver_action,
    giver_action_space,
    has_camera,
    receiver_action_space,
)
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SceneError
from handover_marl.geometry.arrays import ONLY_ROW
from handover_marl.policies.policy import Action, PolicyContext, make_policy_context
from handover_marl.simulation.camera.optics import CameraInfo, describe_calibration, make_camera_info

Info = dict[str, Any]
Observations = dict[str, Observation]
StepResult = tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]


class HandoverEnv(ParallelEnv, EzPickle):  # type: ignore[misc]
    """Two-agent environment in which a person hands an object to a robot.

    The agent `giver` is a human hand that replays a recorded handover and may deviate from it; the
    agent `receiver` is a Franka Panda beside a table. Both act at the same time, and their actions hold
    for one control period (default 0.1 s). The rules are HandoverSim's (Chao et al., ICRA 2022) and are
    checked every physics step (1 ms), so that the last control step of an episode may be shorter.

    Observations and infos are dictionaries by key. Actions are float32 arrays: the receiver's are target joint
    positions (9,) in rad and m, the giver's are deviations (8,) from the recording, and zeros replay the recording.
    World frame, m, rad, s, quaternions xyzw. `docs/reference/environment.md` specifies observations, actions, rewards,
    ends of episodes and infos.

    Copies and pickles are new environments with the same configuration and no running episode.

    Args:
        config: Configuration; `parallel_env` makes it from its arguments.

    Attributes:
        config: Configuration, with the resolved setup.
        dataset: Dataset of the scenes.
        scene_ids: Numbers of the scenes that `reset` draws from, ascending.
        calibration: Camera matrices in the receiver's infos, by key; empty if `obs_mode` has no camera data.
        state_space: Space of the vector that `state` returns, a `gymnasium.spaces.Box`.
        np_random: Random generator from which `reset` draws scenes.

    Raises:
        UnknownNameError: There is no such setup, split, dataset or robot; `EnvConfig` checks the other names.
        SceneError: A scene is not in the split.
        DataNotFoundError: The data folder does not exist.
        RewardError: A user-defined reward cannot be made or copied.
    """

    metadata: dict[str, Any] = {
        "name": "handover_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(self, config: EnvConfig) -> None:
        EzPickle.__init__(self, config)
        self.dataset = open_dataset(config.dataset, config.data_dir, config.robot)
        self.config = config = replace(config, setup=self.dataset.resolve_setup(config.setup))
        split = self.dataset.list_scenes(config.setup, config.split)
        self.scene_ids = choose_scenes(split, config.scenes, f"{config.setup} {config.split}")
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self.render_mode = config.render_mode
        world_config = config.world_config
        self._episode = Episode(config.physics, world_config, config.render_mode == "human", config.sensors)
        self._rewards = RewardSource(config.rewards, world_config.protocol.goal_center)
        self._recorder = TransitionRecorder(config.control_period)
        self._largest_class = max(self.dataset.object_names)
        self._observation: Observation | None = None
        self._partner: EpisodeAgent | None = None
        self.calibration = describe_calibration(self.camera_info()) if has_camera(config.obs_mode) else {}
        self.np_random, _ = seeding.np_random(None)
        self._cycles, self._is_closed = 0, False
        self._observation_spaces = {
            GIVER: giver_observation_space(world_config.giver, self._largest_class),
            RECEIVER: receiver_observation_space(config.obs_mode, self._largest_class, config.cameras),
        }
        self._action_spaces = {GIVER: giver_action_space(world_config.giver), RECEIVER: receiver_action_space()}
        for space in self._action_spaces.values():
            # Libraries that save spaces with a policy save the control period with them.
            space.control_period = config.control_period  # type: ignore[attr-defined]
        flat: Any = spaces.flatten_space(state_space(self._largest_class))
        self.state_space: spaces.Box = flat
        # API checkers try all modes, so that "human" must not be offered without a screen.
        has_display = not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))
        modes = [mode for mode in RENDER_MODES if mode != "human" or mode == config.render_mode or has_display]
        fps = 1.0 / TIME_STEP / config.control_steps
        # Some libraries accept whole numbers only.
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": int(fps) if fps.is_integer() else fps}

    @property
    def object_names(self) -> tuple[str, ...]:
        """Class names of the episode's objects; the object to be handed over is first."""
        return self._episode.scene.info.object_names

    @property
    def policy_context(self) -> PolicyContext:
        """Context for constructors of policies: robot, rules, objects and grasps of this environment."""
        return make_policy_context(self.dataset, self.config.world_config, self.config.setup)

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return the agent's observation space."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the agent's action space."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Info]]:
        """Start an episode of a drawn or a chosen scene.

        Args:
            seed: Seed of the random generator that draws scenes; None keeps its state.
            options: `{"scene_id": n}` chooses a scene of the split; default: draw one.

        Returns:
            Observations and infos by agent.

        Raises:
            OptionError: The seed is negative or not an integer, or `options` is not a mapping.
            SceneError: The scene is not in the split.
            DataNotFoundError, DataFormatError: Files of the scene are missing or damaged.
            RewardError: A user-defined reward fails.
            ResetNeededError: The environment is closed.
        """
        self._check_open()
        # If anything fails below, no episode is running.
        self._end_episode()
        if seed is not None:
            self.np_random, _ = seeding.np_random(check_seed(seed))
        scene = self.dataset.load_scene(self.choose_scene(options, self.np_random))
        robot_seed, camera_seed = draw_seeds(self.np_random, self.config.world_config)
        self._episode.reset(scene, robot_seed)
        self._episode.seed_camera(camera_seed)
        self._cycles = 0
        observations, infos = self._observe(), self._make_infos()
        transition = self._recorder.start(observations, infos)
        names = self._rewards.start(ONLY_ROW, _make_step_data(transition))
        self.agents = list(AGENTS)
        return observations, _add_terms(infos, {agent: dict.fromkeys(own, 0.0) for agent, own in names.items()})

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Let both agents act for one control period, or until the episode ends.

        Args:
            actions: `{"giver": (8,), "receiver": (9,)}`, elements of the agents' action spaces.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent.

        Raises:
            ActionError: An action is malformed; the simulation has not advanced.
            RewardError: A user-defined reward fails, or a term is not a finite number or has an unknown name.
            ResetNeededError: No episode is running, or the environment is closed.
        """
        self._check_open()
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        if not isinstance(actions, Mapping) or actions.keys() - set(AGENTS):
            got = list(actions) if isinstance(actions, Mapping) else type(actions).__name__
            raise ActionError(f"actions must be a dict by agent, for {' and '.join(AGENTS)}, got {got}")
        giver_action = check_giver_action(actions.get(GIVER), self._action_spaces[GIVER])
        robot_target = check_receiver_action(actions.get(RECEIVER))
        started = time.monotonic()
        # If the simulation fails below, no episode is running.
        self.agents = []
        applied = self._advance({RECEIVER: robot_target, GIVER: giver_action})
        self._cycles += 1
        if self.render_mode == "human":
            # The window shows real time.
            time.sleep(max(0.0, self.config.control_steps * TIME_STEP - (time.monotonic() - started)))
        status = self._episode.status
        observations = self._observe()
        terminated = bool(status & ~EpisodeStatus.TIMEOUT)
        cut_off = self.config.max_cycles is not None and self._cycles >= self.config.max_cycles
        truncated = bool(status & EpisodeStatus.TIMEOUT) or (cut_off and not terminated)
        infos = self._make_infos()
        transition = self._recorder.record(
            observations,
            applied,
            infos=infos,
            contacts=self._episode.contacts,
            status=status,
            terminated=terminated,
            truncated=truncated,
        )
        found = self._rewards.compute(ONLY_ROW, _make_step_data(transition))
        terms = {agent: {name: float(value[0]) for name, value in own.items()} for agent, own in found.items()}
        if not (terminated or truncated):
            self.agents = list(AGENTS)
        return (
            observations,
            {agent: sum(terms[agent].values(), 0.0) for agent in AGENTS},
            dict.fromkeys(AGENTS, terminated),
            dict.fromkeys(AGENTS, truncated),
            _add_terms(infos, terms),
        )

    def state(self) -> npt.NDArray[np.float32]:
        """Return the full state as one vector, an element of `state_space`, for centralized critics.

        Raises:
            ResetNeededError: No episode has been started.
        """
        if self._observation is None:
            raise ResetNeededError("no observation yet; call reset() first")
        return np.asarray(spaces.flatten(state_space(self._largest_class), self._observation))

    def render(self) -> npt.NDArray[np.uint8] | None:
        """Return an RGB image (height, width, 3) in mode "rgb_array", else None; mode "human" draws by itself."""
        if self.render_mode is None:
            logger.warn("render() returns no image without a render_mode; pass render_mode='rgb_array'")
        if self.render_mode != "rgb_array":
            return None
        return self._episode.render(self.config.camera or CameraConfig())

    def close(self) -> None:
        """Free the simulation; the environment cannot be used afterwards."""
        self._episode.close()
        self._end_episode()
        self._is_closed = True

    def camera_info(self) -> dict[str, CameraInfo]:
        """Return size, intrinsics K (3, 3) and pose (4, 4) of each camera by name, the same in all episodes."""
        return {camera.name: make_camera_info(camera) for camera in self.config.sensors.cameras}

    def capture_wrist_camera(self) -> CameraCapture:
        """Return depth, segmentation, colors and point clouds of the wrist camera.

        Raises:
            UnknownNameError: There is no camera of the name "wrist".
            ResetNeededError: No episode has been started.
            OptionError: A package is missing that the renderer needs.
        """
        return self._episode.capture_wrist_camera()

    def choose_scene(self, options: dict[str, Any] | None, rng: np.random.Generator) -> int:
        """Return the scene number in the options of `reset`; if they have none, draw one of `scene_ids` by `rng`.

        Raises:
            OptionError: The options are no mapping, or have a key with "scene" in it other than `scene_id`; other
                unknown keys only give a warning.
            SceneError: The scene is not in the split.
        """
        if not isinstance(options or {}, Mapping):
            raise OptionError(f"options must be a dict, got {type(options).__name__}")
        chosen = dict(options or {})
        scene_id = chosen.pop("scene_id", None)
        if any("scene" in str(key).lower() for key in chosen):
            raise OptionError(
                f"options of reset() must have the number of the scene as 'scene_id', got {sorted(chosen)}"
            )
        if chosen:
            # No error, since API checkers pass unknown options.
            warnings.warn(f"unknown options of reset(): {', '.join(map(str, chosen))}; valid: scene_id", stacklevel=3)
        if scene_id is None:
            return int(rng.choice(self.scene_ids))
        self.dataset.check_scene_id(scene_id)
        if scene_id not in self.scene_ids:
            raise SceneError(
                f"scene_id must be in env.scene_ids, the {len(self.scene_ids)} scenes of {self.config.setup} "
                f"{self.config.split}, got {scene_id!r}; choose another scene, or the setup and split that have it"
            )
        return int(scene_id)

    def set_partner(self, agent: str, policy: EpisodePolicy, seed: int | None) -> None:
        """Let a policy act for an agent until the next reset, at the policy's own control period.

        `step` then ignores actions that are passed for `agent`, "giver" or "receiver". The policy's seed is derived
        from the run seed `seed`. So is the cameras' seed if `agent` is "receiver" and `obs_mode` has no camera data.

        Raises:
            PolicyError: The policy is a giver and fails at the start of the episode.
            ResetNeededError: No episode has been started.
        """
        self._partner = EpisodeAgent(self._episode, agent, policy, seed)
        # Cameras that have been observed must not change.
        if agent == RECEIVER and not has_camera(self.config.obs_mode):
            self._episode.seed_camera(derive_seed(seed, "camera"))

    def act_for_partner(self) -> Action:
        """Return the present action of the policy that `set_partner` has set; call the policy if a decision is due.

        Raises:
            ActionError, PolicyError, OptionError: The action is invalid, the policy fails, or its hold time is invalid.
            ResetNeededError: No policy has been set since the last reset.
        """
        if self._partner is None:
            raise ResetNeededError("no policy acts for an agent; call reset() of what control_agent() returned")
        return self._partner.act()

    def _check_open(self) -> None:
        if self._is_closed:
            raise ResetNeededError("the environment is closed; make another one")

    def _end_episode(self) -> None:
        self.agents, self._observation, self._partner = [], None, None

    def _advance(self, actions: dict[str, Action]) -> dict[str, Action]:
        """Simulate one control period with actions by agent; a partner's policy decides at its own control period.

        Returns the actions in effect at the start of the period.
        """
        episode, partner, applied = self._episode, self._partner, list[dict[str, Action]]()
        end = episode.steps + self.config.control_steps
        while episode.steps < end and not episode.status:
            until = end
            if partner is not None:
                actions = {**actions, partner.agent: partner.act()}
                until = min(end, partner.next_decision_step)
            episode.advance(actions[RECEIVER], until - episode.steps, actions[GIVER])
            applied.append(actions)
        return applied[0]

    def _observe(self) -> Observations:
        state = self._observation = self._episode.observe()
        views = {GIVER: self._episode.observe_giver(state), RECEIVER: state}
        # Copies, so that an agent that writes into its arrays does not change the other's.
        copies = {agent: {key: value.copy() for key, value in views[agent].items()} for agent in AGENTS}
        obs_mode = self.config.obs_mode
        camera = self._episode.observe_camera(obs_mode)
        return {GIVER: copies[GIVER], RECEIVER: select_receiver_observation(copies[RECEIVER], camera, obs_mode)}

    def _make_infos(self) -> dict[str, Info]:
        episode = self._episode
        info = {
            "scene_id": episode.scene.info.scene_id,
            "status": int(episode.status),
            "steps": episode.steps,
            "release_step": -1 if episode.release_step is None else episode.release_step,
            "release_reason": -1 if episode.release_reason is None else RELEASE_REASONS.index(episode.release_reason),
        }
        return {GIVER: dict(info), RECEIVER: info | {key: matrix.copy() for key, matrix in self.calibration.items()}}


def check_seed(seed: object) -> int:
    """Return the seed of a reset as int; raise `OptionError` if it is not an integer from 0 on."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise OptionError(f"seed must be an integer from 0 on or None, got {seed!r}")
    return int(seed)


def draw_seeds(rng: np.random.Generator, config: WorldConfig) -> tuple[int, int]:
    """Draw two 32-bit seeds: of the noise on the robot's initial joint positions, and of the cameras.

    The first seed is drawn from `rng`, or is 0 if the configuration has no such noise. The second seed is spawned from
    the seed sequence of `rng`, so that it does not change the numbers that `rng` draws later.
    """
    robot_seed = int(rng.integers(2**32)) if config.initial_joint_noise else 0
    seeds = rng.bit_generator.seed_seq.spawn(1)  # type: ignore[attr-defined]
    return robot_seed, int(seeds[0].generate_state(1)[0])


def _make_step_data(transition: Transition) -> StepData:
    """Return the data of one control step from which rewards are computed, as arrays of a single episode (1, ...)."""

    def read_state(needs_forces: bool) -> dict[str, npt.NDArray[Any]]:
        contacts = transition.contacts
        forces = {"robot_object_force": contacts.robot_object_force, "robot_hand_force": contacts.robot_hand_force}
        values = {"grasped": contacts.both_fingers_touch, **forces}
        return add_episode_axis({**transition.next_state, **{key: np.array(value) for key, value in values.items()}})

    return StepData(np.array([int(transition.status)]), read_state, lambda: [transition])


def _add_terms(infos: dict[str, Info], terms: dict[str, dict[str, float]]) -> dict[str, Info]:
    return {
        agent: {**infos[agent], **{f"reward/{name}": value for name, value in terms[agent].items()}} for agent in AGENTS
    }
