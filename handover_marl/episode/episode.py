"""Episode of a handover: advances giver motion, simulated world, cameras and referee."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP, CameraConfig, WorldConfig
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.camera_observations import (
    BENCHMARK_SENSORS,
    CameraCapture,
    CameraSensor,
    SensorConfig,
)
from handover_marl.episode.giver_motion import NO_DEVIATION, GiverMotion, requests_release
from handover_marl.episode.observations import Observation, observe, observe_giver_motion, select_receiver_observation
from handover_marl.episode.referee import EpisodeStatus, Referee, RefereeState, ReleaseReason, make_judge
from handover_marl.episode.spaces import STATE, has_camera
from handover_marl.errors import ResetNeededError, check_name
from handover_marl.geometry.arrays import ONLY_ROW
from handover_marl.geometry.model_files.meshes import check_collision_meshes
from handover_marl.geometry.panda import HAND_LINK
from handover_marl.simulation.engines import check_physics, make_world
from handover_marl.simulation.world import Contacts, World


class Episode:
    """Simulation of one handover episode at a time; environments and evaluations are built on it.

    Args:
        physics: "exact" equals HandoverSim's simulation in PyBullet bit for bit; "fast" is PyBullet, too, but simulates
            an object only after the robot has come near it, or after the release; "mujoco" is another engine.
        config: Simulated world, protocol and limits of the giver.
        window: Whether to show PyBullet's window.
        sensors: Configuration of the cameras, whose images are rendered only when they are observed.

    Attributes:
        config: Simulated world, protocol and limits of the giver.
        has_wrist_camera: Whether the camera "wrist" exists, and is on the Panda's hand link.
    """

    def __init__(
        self,
        physics: str = "exact",
        config: WorldConfig = OFFICIAL_CONFIG,
        window: bool = False,
        sensors: SensorConfig = BENCHMARK_SENSORS,
    ) -> None:
        check_physics(physics)
        self.config = config
        self._physics, self._window = physics, window
        self._sensors = {
            camera.name: CameraSensor(sensors, physics, config.physics, camera.name) for camera in sensors.cameras
        }
        self.has_wrist_camera = ("wrist", HAND_LINK) in [(camera.name, camera.link) for camera in sensors.cameras]
        self._world: World | None = None
        self._scene: Scene | None = None
        self._motion = GiverMotion(1, config.giver)
        # Contacts of the last step; None if they have not been read from the world.
        self._contacts: Contacts | None = Contacts()
        self._referee = Referee(config.protocol)

    def reset(self, scene: Scene, seed: int = 0) -> None:
        """Reset simulation, giver motion, cameras and referee to the start of a scene.

        Args:
            scene: Scene of the episode.
            seed: Seed of the robot's initial joint positions, if the configuration has noise on them.
        """
        for urdf in scene.urdfs:
            check_collision_meshes(urdf)
        if self._world is None:
            self._world = make_world(self._physics, self.config.physics, self._window)
        self._scene = None
        self._referee = Referee(self.config.protocol)
        self._contacts = Contacts()
        self._world.reset(scene, self._motion.reset(0, scene), self.config.draw_initial_joints(seed))
        self._scene = scene
        for sensor in self._sensors.values():
            sensor.reset(scene, self._world)

    def advance(
        self,
        robot_target: npt.NDArray[np.float32],
        steps: int,
        giver_action: npt.NDArray[np.float32] = NO_DEVIATION,
        on_step: Sequence[Callable[["Episode"], None]] = (),
    ) -> None:
        """Simulate `steps` physics steps with constant actions, or fewer if the episode ends.

        Args:
            robot_target: (9,) float32 target joint positions, 7 arm (rad) and 2 fingers (m).
            steps: Number of physics steps (1 ms).
            giver_action: (8,) float32 deviation from the recording; default: replay the recording.
            on_step: Functions that are called with the episode after every physics step.
        """
        world, motion, referee = self.world, self._motion, self._referee
        n_objects = len(self.scene.info.object_ids)
        target = robot_target.tolist()
        sensors = [sensor for sensor in self._sensors.values() if sensor.has_latency]
        is_requested = bool(requests_release(giver_action))
        while steps > 0 and not referee.status:
            if is_requested and motion.holding[0] and not referee.released:
                referee.release_voluntarily()
                world.release_target()
            is_opening = referee.release_reason is ReleaseReason.VOLUNTARY
            flags = np.array([referee.released]), np.array([is_opening])
            plan = motion.plan_until_release(ONLY_ROW, steps, giver_action[None], *flags)
            world.set_reference(plan.reference.select(0, n_objects))
            planned = plan.steps
            steps -= planned
            simulated = None if on_step or sensors else self._simulate_rollout(world, target, planned)
            if simulated is None:
                simulated = self._simulate_single_steps(world, target, planned, sensors, on_step)
            motion.commit(plan, np.array([simulated]))

    def _simulate_rollout(self, world: World, target: list[float], steps: int) -> int | None:
        """Simulate up to `steps` physics steps in one call; return their number, None if the engine cannot do this."""
        states = RefereeState(*(np.array([value]) for value in self._referee.get_state()))
        rules = self.config.protocol
        simulated = world.rollout(target, steps, make_judge(states, rules), rules)
        if simulated is not None:
            self._referee.restore(states.select_rows(0))
            self._contacts = None
        return simulated

    def _simulate_single_steps(
        self,
        world: World,
        target: list[float],
        steps: int,
        sensors: Sequence[CameraSensor],
        on_step: Sequence[Callable[["Episode"], None]],
    ) -> int:
        """Simulate up to `steps` physics steps with the joint targets `target` (9,) one by one; return their number."""
        referee, simulated = self._referee, 0
        while simulated < steps and not referee.status:
            world.step(target)
            simulated += 1
            for sensor in sensors:
                sensor.record_snapshot(world, referee.steps + 1)
            was_released = referee.released
            self._contacts = world.read_contacts(was_released)
            referee.update(self._contacts)
            for callback in on_step:
                callback(self)
            if referee.released and not was_released and not referee.status:
                world.release_target()
        return simulated

    def observe(self) -> Observation:
        """Return the full state of the simulation as an observation: arrays by the keys of `state_space`."""
        state, time = self.world.read_state(), self.steps * TIME_STEP
        return observe(state, self.scene.info.object_ids, self._referee.released, time)

    def observe_for_policy(self, policy: object, state: Observation) -> Observation:
        """Return the receiver's observation, arrays by key, in the observation mode that its policy declares.

        Args:
            policy: The receiver; its attribute `obs_mode` names the mode, "state" if it has none.
            state: The full state as `observe` returns it now.
        """
        obs_mode = getattr(policy, "obs_mode", STATE)
        if obs_mode == STATE:
            return state
        return select_receiver_observation(state, self.observe_camera(obs_mode), obs_mode)

    def observe_giver(self, state: Observation) -> Observation:
        """Return the giver's observation, see `giver_observation_space`; `state` is the result of `observe` now."""
        own = observe_giver_motion(self._motion, ONLY_ROW)
        return {**state, **{key: values[0] for key, values in own.items()}}

    def seed_camera(self, seed: int) -> None:
        """Seed the random draws of the cameras: randomization, noise, and subsampling of point clouds."""
        for sensor in self._sensors.values():
            sensor.seed(seed)

    def capture_wrist_camera(self) -> CameraCapture:
        """Return images and point clouds of the wrist camera, earlier ones if the camera has latency."""
        check_name("camera", "wrist", self._sensors)
        return self._sensors["wrist"].capture(self.world, self.steps)

    def observe_camera(self, obs_mode: str) -> Observation:
        """Return the camera data of an observation mode by key, as `camera_observation_space` lists them."""
        if not has_camera(obs_mode):
            return {}
        found: Observation = {}
        for sensor in self._sensors.values():
            found |= sensor.observe(obs_mode, self.world, self.steps)
        return found

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """Return an RGB image (height, width, 3) uint8 of the current state of the simulation, seen by `camera`."""
        return self.world.render(camera)

    @property
    def world(self) -> World:
        """Simulated world of the running episode; raises `ResetNeededError` before `reset`."""
        if self._world is None or self._scene is None:
            raise ResetNeededError("no episode is running; call reset() first")
        return self._world

    @property
    def scene(self) -> Scene:
        """Scene of the running episode; raises `ResetNeededError` before `reset`."""
        if self._scene is None:
            raise ResetNeededError("no episode is running; call reset() first")
        return self._scene

    @property
    def contacts(self) -> Contacts:
        """Contacts of robot, object and human hand in the last physics step."""
        if self._contacts is None:
            self._contacts = self.world.read_contacts(self._referee.released)
        return self._contacts

    @property
    def object_offered(self) -> bool:
        """Whether the person holds the object, i.e. has picked it up in the recording and has not released it."""
        return bool(self._motion.holding[0]) and not self._referee.released

    @property
    def status(self) -> EpisodeStatus:
        """Status of the episode after the last physics step."""
        return self._referee.status

    @property
    def steps(self) -> int:
        """Number of physics steps since the start of the episode."""
        return self._referee.steps

    @property
    def release_reason(self) -> ReleaseReason | None:
        """Reason why the person released the object; None before a release."""
        return self._referee.release_reason

    @property
    def release_step(self) -> int | None:
        """Physics step in which the person released the object, see `Referee`; None before a release."""
        return self._referee.release_step

    def close(self) -> None:
        """Free the simulation; `reset` starts another one."""
        if self._world is not None:
            self._world.close()
        self._world = self._scene = None
