"""Human-to-robot handover as a two-agent PettingZoo environment.

| | |
|---|---|
| agents | `giver` (a human hand with an object), `receiver` (a Franka Panda) |
| actions | receiver: Box(9), target joint positions; giver: Box(8), deviation from the replay |
| observations | Dict of float32 arrays; the giver's has the recording's next half second; see `observations` |
| rewards | 1 to both in the step that completes the handover, else 0; or shaped, see `handover_marl.rewards` |
| termination | success, contact of robot and person, or drop |
| truncation | 13 s without success |

Both agents act at once; their actions hold for one control period, during which the rules are checked every
millisecond, so that a step may end early with the episode.

`infos[agent]`: `scene_id`; `status`, an `EpisodeStatus`; `steps`, physics steps so far; `release_step`, the step
whose contacts made the person let go, or None; `release`, why: "active" or "passive", HandoverSim's two, "given",
the giver's own action, or None; after a step `reward_terms`, what the agent's reward is the sum of.

Version history: v0, initial.
"""

import operator
import os
import time
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from pettingzoo import ParallelEnv

from handover_marl.config import CameraConfig, PhysicsConfig
from handover_marl.datasets import open_dataset
from handover_marl.episode import Episode, check_physics
from handover_marl.errors import ActionError, OptionError, ResetNeededError, SceneError, UnknownNameError
from handover_marl.geometry import compose_point
from handover_marl.observations import Observation, giver_observation_space, observation_space
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.rewards import FINGERTIPS, RewardConfig, Rewards, Situation, reward_config
from handover_marl.spaces import (
    check_giver_action,
    check_receiver_action,
    giver_action_space,
    receiver_action_space,
)

GIVER, RECEIVER = "giver", "receiver"
AGENTS = (GIVER, RECEIVER)
RENDER_MODES = ("human", "rgb_array")

StepResult = tuple[
    dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
]


class HandoverEnv(ParallelEnv, EzPickle):  # type: ignore[misc]
    """The two-agent world.

    Args:
        setup: Official setup, "s0" to "s3".
        split: "train", "val" or "test".
        data_dir: Folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        dataset: "dexycb", "synthetic", or "auto": DexYCB when there is a data folder, else synthetic.
        physics: "exact" is HandoverSim's simulation to the bit; "fast", for training, simulates hand and objects
            only while the robot is near them.
        control_period: How long an action holds (s); a whole number of milliseconds, 0.001 or more.
        render_mode: None, "rgb_array" (needs no screen) or "human" (PyBullet's window).
        camera: What "rgb_array" pictures show.
        rewards: "sparse", the task alone; "shaped", with guidance and costs; or weights of your own.

    Raises:
        UnknownNameError: No such setup, split, dataset, physics or render mode.
        OptionError: The control period is not a whole number of milliseconds.
        DataNotFoundError: The data folder is not there.
    """

    metadata: dict[str, Any] = {
        "name": "handover_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        setup: str = "s0",
        split: str = "train",
        data_dir: str | os.PathLike[str] | None = None,
        dataset: str = "auto",
        physics: str = "exact",
        control_period: float = 0.1,
        render_mode: str | None = None,
        camera: CameraConfig | None = None,
        rewards: str | RewardConfig = "sparse",
    ) -> None:
        EzPickle.__init__(
            self, setup, split, data_dir, dataset, physics, control_period, render_mode, camera, rewards
        )
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UnknownNameError("render_mode", render_mode, RENDER_MODES)
        check_physics(physics)
        self.control_steps = control_steps(control_period)
        self.dataset = open_dataset(dataset, data_dir)
        self.scene_ids = self.dataset.split(setup, split)
        self.setup, self.split = setup, split
        self.render_mode = render_mode
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._camera = camera or CameraConfig()
        self._reward_config = reward_config(rewards)
        self._rewards: Rewards | None = None
        self._episode = Episode(physics, window=render_mode == "human")
        self._observation: Observation | None = None
        self._rng: np.random.Generator | None = None
        self._observation_spaces = {GIVER: giver_observation_space(), RECEIVER: observation_space()}
        self._action_spaces = {GIVER: giver_action_space(), RECEIVER: receiver_action_space()}
        self.state_space = spaces.flatten_space(self._observation_spaces[RECEIVER])
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / control_period))}

    def observation_space(self, agent: str) -> spaces.Dict:
        """The agent's observation space."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """The agent's action space."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: Seeds the drawing of scenes; without one, drawing goes on where it was.
            options: `{"scene_id": n}` chooses a scene of the split instead of drawing one.

        Raises:
            SceneError: The scene is not in the split.
            DataNotFoundError, DataFormatError: The scene's files are missing or damaged.
        """
        # Should anything fail below, there is no episode.
        self.agents = []
        self._observation = None
        if seed is not None or self._rng is None:
            self._rng, _ = seeding.np_random(seed)
        self._episode.reset(self.dataset.scene(self._choose_scene(self._rng, options or {})))
        self.agents = list(AGENTS)
        observations = self._observe()
        self._rewards = Rewards(self._reward_config, self._situation(observations[RECEIVER]))
        return observations, self._infos()

    def step(self, actions: dict[str, Any]) -> StepResult:
        """Let both agents act for one control period, or until the episode ends.

        Args:
            actions: `{"giver": (8,), "receiver": (9,)}`, elements of the agents' action spaces.

        Raises:
            ActionError: An action is malformed; the world has not moved.
            ResetNeededError: No episode is running.
        """
        if not self.agents:
            raise ResetNeededError("no episode is running; call reset() before step()")
        robot_target, deviation = self._check_actions(actions)
        started = time.monotonic()
        # Should the simulation fail below, there is no episode any more.
        self.agents = []
        self._episode.advance(robot_target, self.control_steps, deviation)
        if self.render_mode == "human":
            self._keep_pace(started)
        status = self._episode.status
        observations, infos = self._observe(), self._infos()
        rewards = self._reward(observations[RECEIVER], status, infos)
        ended = bool(status & ~EpisodeStatus.TIMEOUT)
        timed_out = bool(status & EpisodeStatus.TIMEOUT)
        if not (ended or timed_out):
            self.agents = list(AGENTS)
        return (
            observations,
            rewards,
            dict.fromkeys(AGENTS, ended),
            dict.fromkeys(AGENTS, timed_out),
            infos,
        )

    def state(self) -> npt.NDArray[np.float32]:
        """Everything observed as one vector, for centralised critics; an element of `state_space`."""
        if self._observation is None:
            raise ResetNeededError("there is no state yet; call reset() before state()")
        return np.asarray(spaces.flatten(self._observation_spaces[RECEIVER], self._observation))

    def render(self) -> npt.NDArray[np.uint8] | None:
        """An RGB picture (height, width, 3) with "rgb_array"; with "human" the window shows itself."""
        if self.render_mode != "rgb_array":
            return None
        return self._episode.render(self._camera)

    def close(self) -> None:
        """Free the simulation."""
        self._episode.close()
        self.agents = []
        self._observation = None

    def _check_actions(self, actions: dict[str, Any]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        if not isinstance(actions, Mapping):
            raise ActionError(f"step() takes a dict of actions by agent, not {type(actions).__name__}")
        unknown = sorted(map(str, actions.keys() - set(AGENTS)))
        if unknown:
            raise ActionError(f"there is no agent {unknown[0]!r}; actions are for {' and '.join(AGENTS)}")
        return check_receiver_action(actions.get(RECEIVER)), check_giver_action(actions.get(GIVER))

    def _choose_scene(self, rng: np.random.Generator, options: dict[str, Any]) -> int:
        if not isinstance(options, Mapping):
            raise OptionError(f"reset() takes options as a dict, not {type(options).__name__}")
        unknown = sorted(map(str, options.keys() - {"scene_id"}))
        if unknown:
            warnings.warn(f"reset() knows no option {', '.join(unknown)}; valid: scene_id", stacklevel=3)
        scene_id = options.get("scene_id")
        if scene_id is None:
            return int(rng.choice(self.scene_ids))
        try:
            chosen = operator.index(scene_id)
        except TypeError:
            chosen = -1
        if chosen not in self.scene_ids:
            raise SceneError(
                f"scene {scene_id!r} is not in {self.setup} {self.split}, which has {len(self.scene_ids)} scenes "
                f"from {self.scene_ids[0]} to {self.scene_ids[-1]}; env.scene_ids lists them"
            )
        return chosen

    def _observe(self) -> dict[str, Observation]:
        self._observation = self._episode.observe()
        seen = {GIVER: self._episode.observe_as_giver(self._observation), RECEIVER: self._observation}
        # Copies, so that what one agent does to its arrays stays unseen by the other.
        return {agent: {key: value.copy() for key, value in seen[agent].items()} for agent in AGENTS}

    def _situation(self, seen: Observation) -> Situation:
        episode = self._episode
        return Situation(
            time=float(seen["time"][0]),
            gripper=tuple(seen["gripper_pose"][:3].tolist()),
            fingertips=tuple(compose_point(seen["gripper_pose"], FINGERTIPS).tolist()),
            item=tuple(seen["object_poses"][0, :3].tolist()),
            grasped=episode.grasped,
            deviation=tuple(episode.deviation[1:].tolist()),
            held_out=episode.held_out,
        )

    def _reward(
        self, seen: Observation, status: EpisodeStatus, infos: dict[str, dict[str, Any]]
    ) -> dict[str, float]:
        """Both agents' rewards; their terms go into the infos."""
        now, rewards = self._situation(seen), self._rewards
        if rewards is None:
            raise ResetNeededError("no episode is running; call reset() before step()")
        terms = {GIVER: rewards.giver(now, status), RECEIVER: rewards.receiver(now, status)}
        rewards.go_on(now)
        for agent in AGENTS:
            infos[agent]["reward_terms"] = terms[agent]
        return {agent: sum(terms[agent].values()) for agent in AGENTS}

    def _infos(self) -> dict[str, dict[str, Any]]:
        episode = self._episode
        info = {
            "scene_id": episode.scene.info.scene_id,
            "status": episode.status,
            "steps": episode.steps,
            "release_step": episode.release_step,
            "release": None if episode.release is None else episode.release.value,
        }
        return {agent: dict(info) for agent in AGENTS}

    def _keep_pace(self, started: float) -> None:
        wait = self.control_steps * PhysicsConfig().time_step - (time.monotonic() - started)
        if wait > 0:
            time.sleep(wait)


def control_steps(control_period: float) -> int:
    """Physics steps in a control period (s).

    Raises:
        OptionError: It is not a whole number of milliseconds, or none at all.
    """
    time_step = PhysicsConfig().time_step
    try:
        steps = round(control_period / time_step)
    except (TypeError, ValueError, OverflowError):
        steps = 0
    if steps < 1 or abs(steps * time_step - control_period) > 1e-9:
        raise OptionError(
            f"control_period={control_period!r} must be a whole number of milliseconds given in seconds, "
            "such as 0.1 or 0.001"
        )
    return steps
