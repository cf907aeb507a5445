"""Episodes of GA-DDPG's protocol without physics: the object rests, the arm lags, what is seen is drawn by rays.

Memory, resampling, the counter and the end are the deployed receiver's own. Some episodes begin on the way that the
planner found; steps are the expert's at first, then the network's, and some are disturbed. Whatever is met is a
state to learn from, with the goal that the expert has from there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handover_marl.config import PhysicsConfig
from handover_marl.datasets.scene import SceneAssets
from handover_marl.imitation.gaddpg.expert import Expert, ExpertConfig, ExpertPlan
from handover_marl.imitation.gaddpg.kinematic_arm import KinematicArm
from handover_marl.imitation.gaddpg.situations import Situation, hidden
from handover_marl.imitation.gaddpg.states import States, joined, state
from handover_marl.models.panda import OPEN
from handover_marl.models.poses import compose, inverse
from handover_marl.receivers.gaddpg_memory import FINGER_POINTS, MemoryConfig, PointMemory
from handover_marl.sim.camera.optics import PINHOLE, deproject
from handover_marl.sim.camera.photo import Seen
from handover_marl.sim.rays.ray_camera import RayCamera
from handover_marl.sim.world import Snapshot

Array = npt.NDArray[np.float64]
#: From clouds (n, 4, 1024) and decisions left (n,) to steps (n, 6).
Policy = Callable[[Array, Array], npt.NDArray[np.floating]]


@dataclass(frozen=True)
class EpisodeConfig:
    """How episodes are played.

    Attributes:
        longest: Decisions at most.
        under_way: Share of episodes that begin on the planner's way.
        expert: Where a network plays, so many decisions at most are the expert's first, in
        led: this share of episodes.
        disturbed: Share of the expert's decisions that are disturbed, along each axis with the standard deviation
        shift: this (m), and turned by
        turn: this (rad).
    """

    longest: int = 24
    under_way: float = 0.3
    expert: int = 10
    led: float = 0.5
    disturbed: float = 0.3
    shift: float = 0.025
    turn: float = 0.12


@dataclass(eq=False)
class _Episode:
    situation: Situation
    plan: ExpertPlan
    rng: np.random.Generator
    joints: Array
    memory: PointMemory
    led: int
    camera: RayCamera
    over: bool = False


class Studio:
    """Plays episodes, several side by side so that the network is asked for all at once.

    Args:
        arm: How decisions move the arm.
        expert: Who knows where to go.
        physics: Where robot and table stand.
        assets: The models to draw for an object's class.
        episodes: How episodes are played.
        config: How the expert chooses.
    """

    def __init__(
        self,
        arm: KinematicArm,
        expert: Expert,
        physics: PhysicsConfig,
        assets: Callable[[str], SceneAssets],
        episodes: EpisodeConfig,
        config: ExpertConfig,
    ) -> None:
        self._arm, self._expert, self._physics, self._assets = arm, expert, physics, assets
        self._config, self._expert_config = episodes, config

    def play(
        self, situations: Sequence[Situation], plans: Sequence[ExpertPlan], policy: Policy | None, seed: int
    ) -> States:
        """The states of an episode of each situation.

        Args:
            situations: They.
            plans: The expert's, one each.
            policy: Who plays, or None for the expert.
            seed: Of what is drawn, with the situations' numbers.
        """
        episodes = [
            self._begun(situation, plan, policy is not None, np.random.default_rng((seed, situation.number)))
            for situation, plan in zip(situations, plans, strict=True)
        ]
        found: list[States] = []
        for number in range(self._config.longest):
            going = [episode for episode in episodes if not episode.over]
            seen = [(episode, cloud) for episode in going if (cloud := self._look(episode, found)) is not None]
            for (episode, _), step in zip(seen, self._steps(seen, policy, number), strict=True):
                episode.memory.remaining -= 1
                episode.joints = self._arm.moved(episode.joints, step)
                episode.over = episode.memory.remaining == 0 or episode.memory.caged(self._hand_matrix(episode))
        return joined(found)

    def _begun(self, situation: Situation, plan: ExpertPlan, network: bool, rng: np.random.Generator) -> _Episode:
        config, joints = self._config, situation.joints
        memory = PointMemory(MemoryConfig(seed=int(rng.integers(2**31))))
        if rng.random() < config.under_way:
            # Not where the fingers are round the object already.
            first = int(rng.integers(max(1, len(plan.path) - 3)))
            joints, memory.remaining = plan.path[first], max(3, memory.remaining - first)
        led = config.longest
        if network:
            led = int(rng.integers(config.expert + 1)) if rng.random() < config.led else 0
        camera = RayCamera(self._assets(situation.object_name), self._physics)
        return _Episode(situation, plan, rng, joints, memory, led, camera)

    def _look(self, episode: _Episode, found: list[States]) -> Array | None:
        """(4, 1024) what the network is shown, noted as a state; None, and the end, where nothing was ever seen."""
        situation, memory = episode.situation, episode.memory
        robot = np.array([*episode.joints, OPEN, OPEN], dtype=np.float32)
        photo = episode.camera.sought(Snapshot(robot, None, situation.dof[None]))
        points = deproject(photo.depth, photo.shows(Seen.TARGET))
        hand = self._arm.arm.hand(episode.joints)
        if situation.ball[3] > 0.0 and len(points):
            points = points[~hidden(points, hand, np.array(PINHOLE), situation.ball)]
        pose = self._hand_matrix(episode)
        memory.see(points, pose)
        if memory.cloud.shape[1] == 0:
            episode.over = True
            return None
        cloud = memory.network_input(pose)[:, FINGER_POINTS.shape[1] :]
        distinct = min(memory.cloud.shape[1], cloud.shape[1])
        goal = compose(inverse(hand), episode.plan.goal(hand, self._expert_config))
        found.append(state(cloud[:3, :distinct].T, goal, memory.remaining))
        return cloud

    def _steps(self, seen: Sequence[tuple[_Episode, Array]], policy: Policy | None, number: int) -> list[Array]:
        """What each of some episodes does next."""
        steps: list[Array | None] = [self._led(episode) if number < episode.led else None for episode, _ in seen]
        asked = [place for place, step in enumerate(steps) if step is None]
        if asked and policy is not None:
            clouds = np.stack([seen[place][1] for place in asked])
            remaining = np.array([float(seen[place][0].memory.remaining) for place in asked])
            for place, step in zip(asked, policy(clouds, remaining), strict=True):
                steps[place] = np.asarray(step, dtype=np.float64)
        return [step for step in steps if step is not None]

    def _led(self, episode: _Episode) -> Array:
        """The expert's step, disturbed now and then."""
        config, rng = self._config, episode.rng
        hand = self._arm.arm.hand(episode.joints)
        goal = episode.plan.goal(hand, self._expert_config)
        step = self._expert.step(hand, goal, episode.memory.remaining)
        noise = rng.standard_normal(6) * np.repeat([config.shift, config.turn], 3)
        disturbed: Array = step + noise * (rng.random() < config.disturbed)
        return disturbed

    def _hand_matrix(self, episode: _Episode) -> Array:
        """(4, 4) pose of the hand in the robot's base frame."""
        hand = compose(inverse(self._arm.arm.base), self._arm.arm.hand(episode.joints))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(hand[3:]).as_matrix(), hand[:3]
        return matrix
