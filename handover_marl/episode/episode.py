"""One handover as it is played: giver's clock, world and referee, advanced together."""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL, TIME_STEP, CameraConfig, WorldConfig
from handover_marl.datasets.scene import Scene
from handover_marl.episode.lockstep import Stretch, play_together
from handover_marl.episode.observations import (
    ALL,
    Observation,
    as_receiver,
    check_observes,
    observe,
    observe_as_giver,
)
from handover_marl.episode.playback import NO_DEVIATION, Playback
from handover_marl.episode.preview import Preview
from handover_marl.episode.sight import BENCHMARK_SIGHT, Sight, SightConfig, View
from handover_marl.episode.spaces import GiverAction
from handover_marl.errors import ResetNeededError
from handover_marl.protocol.contacts import Contacts
from handover_marl.protocol.referee import Referee
from handover_marl.protocol.release import Release
from handover_marl.protocol.status import EpisodeStatus
from handover_marl.sim.engines import check_physics, make_world
from handover_marl.sim.motion import Motion
from handover_marl.sim.world import RollingWorld, World

if TYPE_CHECKING:
    from handover_marl.episode.ensemble import Ensemble

# The giver's motion is worked out for so many steps (1 ms) ahead.
_STRETCH = 200


class Episode:
    """Plays scenes one after another. The PettingZoo environment and the benchmark both stand on it.

    Args:
        physics: "exact" is HandoverSim's simulation to the bit, "fast" leaves out what cannot touch, "mujoco" is
            another engine.
        config: The world and the rules.
        window: Whether to show PyBullet's window.
        sight: How the wrist camera's pictures are made; drawn only when asked for.

    Attributes:
        config: The world and the rules.
    """

    def __init__(
        self,
        physics: str = "exact",
        config: WorldConfig = OFFICIAL,
        window: bool = False,
        sight: SightConfig = BENCHMARK_SIGHT,
    ) -> None:
        check_physics(physics)
        self.config = config
        self._roll: Callable[[Stretch], None] = lambda stretch: play_together([stretch], config.protocol)
        self._physics, self._window = physics, window
        self._sight = Sight(sight, physics, config.physics)
        self._world: World | None = None
        self._playback: Playback | None = None
        self._preview: Preview | None = None
        # What touched last; None until somebody asks.
        self._contacts: Contacts | None = Contacts()
        self._referee = Referee(config.protocol)

    def join(self, ensemble: "Ensemble", number: int) -> None:
        """Be played beside others from now on.

        Args:
            ensemble: Where, with the same physics and configuration.
            number: As which of them.
        """
        self.close()
        self._world = ensemble.world(number)
        self._roll = functools.partial(ensemble.play, number)

    def reset(self, scene: Scene) -> None:
        """Go to the start of a scene."""
        if self._world is None:
            self._world = make_world(self._physics, self.config.physics, self._window)
        self._playback = self._preview = None
        self._referee = Referee(self.config.protocol)
        self._contacts = Contacts()
        playback = Playback(scene, self.config.giver)
        self._world.reset(scene, playback.start())
        self._sight.reset(scene, self._world)
        self._playback = playback

    def advance(
        self,
        robot_target: npt.NDArray[np.float32],
        steps: int,
        giver_action: npt.NDArray[np.float32] = NO_DEVIATION,
        on_step: Sequence[Callable[["Episode"], None]] = (),
    ) -> None:
        """Simulate up to `steps` physics steps under one pair of actions; stop early at the episode's end.

        Args:
            robot_target: (9,) float32 target joint positions, 7 arm (rad) and 2 fingers (m).
            steps: Physics steps of 1 ms.
            giver_action: (8,) float32 deviation from the replay, none by default.
            on_step: Called after every physics step.
        """
        world, playback, referee = self._running()
        target = robot_target.tolist()
        if GiverAction.of(giver_action).release and playback.holding and not referee.released:
            referee.give()
            world.release_target()
        while steps > 0 and not referee.status:
            stretch = min(steps, _STRETCH)
            given = referee.release is Release.GIVEN
            motion = playback.plan(stretch, giver_action, referee.released, opening=given)
            playback.commit(self._play(target, motion, on_step))
            steps -= stretch

    def _play(self, robot_target: list[float], motion: Motion, on_step: Sequence[Callable[["Episode"], None]]) -> int:
        """Simulate the steps of a motion, or until the episode ends; how many that were."""
        world, _, referee = self._running()
        world.lead(motion)
        if isinstance(world, RollingWorld) and not on_step and not self._sight.remembers:
            stretch = Stretch(world, referee, robot_target, len(motion))
            self._roll(stretch)
            self._contacts = None
            return stretch.done
        for done in range(1, len(motion) + 1):
            world.step(robot_target)
            if self._sight.remembers:
                self._sight.note(world)
            released_before = referee.released
            self._contacts = contacts = world.contacts(released_before)
            ended = referee.update(contacts)
            for look in on_step:
                look(self)
            if ended:
                return done
            if referee.released and not released_before:
                world.release_target()
        return len(motion)

    def observe(self) -> Observation:
        """What the agents see now."""
        world, playback, referee = self._running()
        time = referee.steps * TIME_STEP
        return observe(world.state(), playback.scene.info.object_ids, referee.released, time)

    def observe_for(self, policy: object, observation: Observation) -> Observation:
        """What a receiver's policy is shown, as far as it says what it wants to see; everything, if it does not.

        Args:
            policy: The receiver; see `handover_marl.policies.policy.Policy`.
            observation: What `observe` says now.
        """
        sight, observes = getattr(policy, "sight", None), getattr(policy, "observes", ALL)
        if sight is None and observes == ALL:
            return observation
        check_observes(observes, sight)
        return as_receiver(observation, self.observe_sight(sight), observes)

    def observe_as_giver(self, observation: Observation) -> Observation:
        """What the giver sees beside what it shares with the receiver.

        Args:
            observation: What `observe` says now.
        """
        _, playback, _ = self._running()
        if self._preview is None:
            self._preview = Preview(playback.scene, self.config.giver)
        return observe_as_giver(observation, playback, self._preview)

    def seed_sight(self, seed: int) -> None:
        """Say what the camera's random draws depend on, beside the step."""
        self._sight.seed(seed)

    def look(self) -> View:
        """What the wrist camera shows."""
        return self._sight.look(self.world, self.steps)

    def observe_sight(self, sight: str | None) -> Observation:
        """What a kind of sight adds to the receiver's observation: see `sight_space`.

        Raises:
            OptionError: The renderer needs an extra that is not installed.
            DataFormatError, SimulationError: What a model shows cannot be read.
        """
        return self._sight.observe(sight, self.world, self.steps)

    def render(self, camera: CameraConfig) -> npt.NDArray[np.uint8]:
        """An RGB picture (height, width, 3) of the present state."""
        return self._running()[0].render(camera)

    @property
    def world(self) -> World:
        """The simulated world of the scene being played."""
        return self._running()[0]

    @property
    def scene(self) -> Scene:
        """The scene being played."""
        return self._running()[1].scene

    @property
    def contacts(self) -> Contacts:
        """What touched in the last step."""
        if self._contacts is None:
            world, _, referee = self._running()
            self._contacts = world.contacts(referee.released)
        return self._contacts

    @property
    def grasped(self) -> bool:
        """Whether both fingers were on the object in the last step."""
        return self.contacts.both_fingers

    @property
    def held_out(self) -> bool:
        """Whether the person holds the object, picked up and not let go."""
        _, playback, referee = self._running()
        return playback.holding and not referee.released

    @property
    def deviation(self) -> npt.NDArray[np.float32]:
        """(7,) the giver's playback rate, wrist displacement (m) and rotation vector (rad) as they are now."""
        return self._running()[1].deviation

    @property
    def status(self) -> EpisodeStatus:
        """The verdict so far."""
        return self._referee.status

    @property
    def steps(self) -> int:
        """Physics steps simulated since the reset."""
        return self._referee.steps

    @property
    def release(self) -> Release | None:
        """Why the human let go, or None."""
        return self._referee.release

    @property
    def release_step(self) -> int | None:
        """The step whose contacts made the human let go, or None."""
        return self._referee.release_step

    def close(self) -> None:
        """Free the simulation."""
        if self._world is not None:
            self._world.close()
        self._world = self._playback = None

    def _running(self) -> tuple[World, Playback, Referee]:
        if self._world is None or self._playback is None:
            raise ResetNeededError("no scene is being played; call reset() first")
        return self._world, self._playback, self._referee
