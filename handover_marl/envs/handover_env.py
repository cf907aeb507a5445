"""Human-to-robot handover as a two-agent PettingZoo environment.

| | |
|---|---|
| agents | `giver` (a human hand with an object), `receiver` (a Franka Panda) |
| actions | receiver: Box(9), target joint positions; giver: Box(8), deviation from the replay |
| observations | Dict of arrays; the giver's has the recording's next half second; see `observations` |
| rewards | 1 to both in the step that completes the handover, else 0; or shaped, see `handover_marl.envs.rewards` |
| termination | success, contact of robot and person, or drop |
| truncation | 13 s without success, or `max_cycles` steps |

Both agents act at once; their actions hold for one control period, during which the rules are checked every
millisecond, so that a step may end early with the episode.

`infos[agent]` has the same keys from reset on, all numbers: `scene_id`; `status`, the bits of an `EpisodeStatus`;
`steps`, physics steps so far; `release_step`, the step whose contacts made the person let go, or -1; `release`, why:
an index into `RELEASES`, or -1; `reward/...`, the weighted terms that the agent's last reward is the sum of.

Version history: v0, initial.
"""

import os
import time
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import EzPickle, seeding
from pettingzoo import ParallelEnv

from handover_marl.config import OFFICIAL, TIME_STEP, CameraConfig, WorldConfig
from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import choose_scenes
from handover_marl.envs.arguments import (
    AGENTS,
    GIVER,
    RECEIVER,
    checked_actions,
    checked_cycles,
    checked_scene,
    control_steps,
    has_screen,
)
from handover_marl.envs.rewards import RewardConfig, Rewards, Situation, reward_config
from handover_marl.episode.episode import Episode
from handover_marl.episode.observations import (
    ALL,
    Observation,
    as_receiver,
    giver_observation_space,
    observation_space,
    receiver_observation_space,
)
from handover_marl.episode.sight import SightConfig, View
from handover_marl.episode.spaces import (
    giver_action_space,
    receiver_action_space,
)
from handover_marl.errors import ResetNeededError, UnknownNameError
from handover_marl.models.panda import FINGERTIPS, PANDA
from handover_marl.models.poses import compose_point
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.sim.camera.imperfections import CameraImperfections
from handover_marl.sim.camera.optics import REFERENCE
from handover_marl.sim.engines import check_physics
from handover_marl.sim.renderers import chosen_renderer
from handover_marl.sim.scene_pictures import check_drawing

if TYPE_CHECKING:
    from handover_marl.episode.ensemble import Ensemble

RENDER_MODES = ("human", "rgb_array")
#: What `release` in infos is an index into.
RELEASES = tuple(Release)

Info = dict[str, float]
Observations = dict[str, Observation]
StepResult = tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]


class HandoverEnv(ParallelEnv, EzPickle):  # type: ignore[misc]
    """The two-agent world.

    A copy or a pickle of it is a new environment with the same options: an episode that runs does not come along.

    Args:
        setup: Official setup, "s0" to "s3".
        split: "train", "val" or "test".
        data_dir: Folder in HandoverSim's layout; default: the environment variable HANDOVER_MARL_DATA.
        dataset: "dexycb", "synthetic", or "auto": DexYCB when there is a data folder, else synthetic.
        physics: "exact" is HandoverSim's simulation to the bit; "fast", for training, simulates hand and objects
            only while the robot is near them; "mujoco" is another engine, faster again.
        control_period: How long an action holds (s); a whole number of milliseconds, 0.001 or more.
        render_mode: None, "rgb_array" (needs no screen) or "human" (PyBullet's window).
        camera: What "rgb_array" pictures show.
        rewards: "sparse", the task alone; "shaped", with guidance and costs; or weights of your own.
        scenes: Only these scenes of the split.
        max_cycles: Episodes are cut off after so many steps, to learn from more of them; None plays to the end.
        config: The world and the rules.
        robot: "panda", or "panda_camera" with HandoverSim's depth camera on its hand.
        sight: What the receiver is shown of the wrist camera, "points", "clouds", "images" or None; either robot has
            the view.
        observe: "all", or "sight": proprioception and sight alone, so that nobody learns from the true pose.
        renderer: "bullet", "rays", or "auto": bullet in exact physics, rays in others.
        geometry: "reference" puts points where HandoverSim puts them, "true" where they are.
        imperfections: What is wrong with the camera: None, "realsense" or `CameraImperfections`.

    Raises:
        UnknownNameError: No such setup, split, dataset, physics, robot, sight, renderer or render mode.
        OptionError: The control period is not a whole number of milliseconds, or `max_cycles` no whole number; sight
            alone is wanted and there is none, or what draws it is not installed.
        SceneError: A scene is not in the split.
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
        scenes: Iterable[int] | None = None,
        max_cycles: int | None = None,
        config: WorldConfig = OFFICIAL,
        robot: str = PANDA,
        sight: str | None = None,
        observe: str = ALL,
        renderer: str = "auto",
        geometry: str = REFERENCE,
        imperfections: str | CameraImperfections | None = None,
    ) -> None:
        # Told below if it is no list, where the split is known.
        chosen = list(scenes) if isinstance(scenes, Iterable) else scenes
        EzPickle.__init__(
            self,
            *(setup, split, data_dir, dataset, physics, control_period, render_mode, camera, rewards),
            *(chosen, max_cycles, config, robot, sight, observe, renderer, geometry, imperfections),
        )
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UnknownNameError("render_mode", render_mode, RENDER_MODES)
        check_physics(physics)
        if render_mode is not None:
            check_drawing(f"render_mode={render_mode!r}")
        self.config = config
        drawn = SightConfig(renderer, geometry, imperfections)
        seen = receiver_observation_space(sight, observe)
        chosen_renderer(renderer, physics, installed=sight is not None)
        self.sight, self.observe = sight, observe
        self._episode = Episode(physics, config, window=render_mode == "human", sight=drawn)
        self.control_period = control_period
        self.control_steps = control_steps(control_period)
        self.max_cycles = checked_cycles(max_cycles)
        self.dataset = open_dataset(dataset, data_dir, robot)
        self.scene_ids = choose_scenes(self.dataset.split(setup, split), chosen, f"{setup} {split}")
        self.setup, self.split = setup, split
        self.render_mode = render_mode
        self.possible_agents = list(AGENTS)
        self.agents: list[str] = []
        self._camera = camera or CameraConfig()
        self._reward_config = reward_config(rewards)
        self._rewards: Rewards | None = None
        self._observation: Observation | None = None
        self._rng: np.random.Generator | None = None
        self._cycles = 0
        self._observation_spaces = {GIVER: giver_observation_space(config.giver), RECEIVER: seen}
        self._action_spaces = {GIVER: giver_action_space(config.giver), RECEIVER: receiver_action_space()}
        for space in self._action_spaces.values():
            # Libraries that save spaces with a policy save with them how long its actions hold.
            space.control_period = control_period  # type: ignore[attr-defined]
        flat: Any = spaces.flatten_space(observation_space())
        self.state_space: spaces.Box = flat
        modes = [mode for mode in RENDER_MODES if mode != "human" or mode == render_mode or has_screen()]
        self.metadata = {**self.metadata, "render_modes": modes, "render_fps": max(1, round(1.0 / control_period))}

    @property
    def object_names(self) -> tuple[str, ...]:
        """YCB names of the present episode's objects, the given one first."""
        return self._episode.scene.info.object_names

    @property
    def np_random(self) -> np.random.Generator:
        """What scenes are drawn with."""
        if self._rng is None:
            self._rng, _ = seeding.np_random(None)
        return self._rng

    def observation_space(self, agent: str) -> spaces.Dict:
        """The agent's observation space."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """The agent's action space."""
        return self._action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Info]]:
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
        if seed is not None:
            self._rng, _ = seeding.np_random(seed)
        self._episode.reset(self.dataset.scene(self._chosen_scene(options)))
        self._episode.seed_sight(self._next_camera_seed())
        self._cycles = 0
        self.agents = list(AGENTS)
        observations = self._observe()
        start = self._situation(self._present())
        self._rewards = Rewards(self._reward_config, self.config.protocol.goal_center, start)
        return observations, self._infos(self._no_reward())

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
        robot_target, deviation = checked_actions(actions, self._action_spaces[GIVER])
        started = time.monotonic()
        # Should the simulation fail below, there is no episode any more.
        self.agents = []
        self._episode.advance(robot_target, self.control_steps, deviation)
        self._cycles += 1
        if self.render_mode == "human":
            self._keep_pace(started)
        status = self._episode.status
        observations = self._observe()
        terms = self._reward(self._present(), status)
        ended = bool(status & ~EpisodeStatus.TIMEOUT)
        cut_off = self.max_cycles is not None and self._cycles >= self.max_cycles
        timed_out = bool(status & EpisodeStatus.TIMEOUT) or (cut_off and not ended)
        if not (ended or timed_out):
            self.agents = list(AGENTS)
        return (
            observations,
            {agent: sum(terms[agent].values()) for agent in AGENTS},
            dict.fromkeys(AGENTS, ended),
            dict.fromkeys(AGENTS, timed_out),
            self._infos(terms),
        )

    def state(self) -> npt.NDArray[np.float32]:
        """Everything observed as one vector, for centralised critics; an element of `state_space`."""
        return np.asarray(spaces.flatten(observation_space(), self._present()))

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

    def _chosen_scene(self, options: dict[str, Any] | None) -> int:
        where = f"{self.setup} {self.split}"
        wanted = checked_scene(options or {}, self.scene_ids, where)
        return int(self.np_random.choice(self.scene_ids)) if wanted is None else wanted

    def _observe(self) -> Observations:
        self._observation = self._episode.observe()
        seen = {GIVER: self._episode.observe_as_giver(self._observation), RECEIVER: self._observation}
        # Copies, so that what one agent does to its arrays stays unseen by the other.
        copies = {agent: {key: value.copy() for key, value in seen[agent].items()} for agent in AGENTS}
        shown = as_receiver(copies[RECEIVER], self._episode.observe_sight(self.sight), self.observe)
        return {GIVER: copies[GIVER], RECEIVER: shown}

    def observation_for(self, agent: str, policy: object) -> Observation:
        """What a policy that takes an agent's part is shown now, whatever the environment shows who learns in it.

        Args:
            agent: "giver" or "receiver".
            policy: It says what it wants to see; see `handover_marl.policies.policy.Policy`.

        Raises:
            ResetNeededError: No episode has begun.
        """
        now = self._present()
        seen = self._episode.observe_as_giver(now) if agent == GIVER else self._episode.observe_for(policy, now)
        return {key: value.copy() for key, value in seen.items()}

    def join(self, ensemble: "Ensemble", number: int) -> None:
        """Play from now on beside other environments of the same physics and configuration.

        Args:
            ensemble: Where.
            number: As which of them.
        """
        self.agents = []
        self._observation = None
        self._episode.join(ensemble, number)

    def look(self) -> View:
        """What the wrist camera shows at this moment, whatever `sight` is: depth, segmentation, colours and all points.

        Raises:
            ResetNeededError: No episode has begun.
            OptionError: The renderer needs an extra that is not installed.
        """
        return self._episode.look()

    def _next_camera_seed(self) -> int:
        """One for every episode, without drawing from what scenes are drawn from."""
        seeds = self.np_random.bit_generator.seed_seq.spawn(1)  # type: ignore[attr-defined]
        return int(seeds[0].generate_state(1)[0])

    def _present(self) -> Observation:
        """All there is to see, whatever is shown."""
        if self._observation is None:
            raise ResetNeededError("there is nothing to see yet; call reset() first")
        return self._observation

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

    def _reward(self, seen: Observation, status: EpisodeStatus) -> dict[str, dict[str, float]]:
        """The terms of both agents' rewards."""
        rewards = self._rewards
        if rewards is None:
            raise ResetNeededError("no episode is running; call reset() before step()")
        if rewards.only_outcomes:
            receiver, giver = rewards.outcome(status)
            return {GIVER: giver, RECEIVER: receiver}
        now = self._situation(seen)
        terms = {GIVER: rewards.giver(now, status), RECEIVER: rewards.receiver(now, status)}
        rewards.go_on(now)
        return terms

    def _no_reward(self) -> dict[str, dict[str, float]]:
        weights = {GIVER: fields(self._reward_config.giver), RECEIVER: fields(self._reward_config.receiver)}
        return {agent: {part.name: 0.0 for part in weights[agent]} for agent in AGENTS}

    def _infos(self, terms: dict[str, dict[str, float]]) -> dict[str, Info]:
        episode = self._episode
        info = {
            "scene_id": episode.scene.info.scene_id,
            "status": int(episode.status),
            "steps": episode.steps,
            "release_step": -1 if episode.release_step is None else episode.release_step,
            "release": -1 if episode.release is None else RELEASES.index(episode.release),
        }
        return {
            agent: {**info, **{f"reward/{name}": value for name, value in terms[agent].items()}} for agent in AGENTS
        }

    def _keep_pace(self, started: float) -> None:
        wait = self.control_steps * TIME_STEP - (time.monotonic() - started)
        if wait > 0:
            time.sleep(wait)
