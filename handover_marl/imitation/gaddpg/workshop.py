"""What makes plans and states, in one process or several: the same whatever their number."""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import TypeVar

from handover_marl.config import OFFICIAL
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.data_place import DataPlace, check_scene
from handover_marl.datasets.scene import SceneAssets
from handover_marl.imitation.gaddpg.expert import Expert, ExpertConfig, ExpertPlan
from handover_marl.imitation.gaddpg.grasp_book import GraspBook, PriceConfig
from handover_marl.imitation.gaddpg.imitation_episodes import EpisodeConfig, Policy, Studio
from handover_marl.imitation.gaddpg.kinematic_arm import KinematicArm
from handover_marl.imitation.gaddpg.situations import SituationConfig, Situations
from handover_marl.imitation.gaddpg.states import States
from handover_marl.models.panda import PANDA_CAMERA
from handover_marl.models.ycb import CLASS_NAMES, SCENE_CLASSES
from handover_marl.policies.context import context_of
from handover_marl.pools.pool import Job
from handover_marl.pools.pool_config import PoolConfig
from handover_marl.pools.working import answers, open_pool

_Task = TypeVar("_Task")
_Made = TypeVar("_Made")


@dataclass(frozen=True)
class WorkshopConfig:
    """What is made, from what.

    Attributes:
        scenes: Training scenes.
        dataset: dexycb, synthetic, or auto.
        data_dir: Folder in HandoverSim's layout.
        seed: Of everything.
        situations: Where objects and arms are.
        prices: What grasps cost.
        expert: How goals are chosen.
        episodes: How episodes are played.
    """

    scenes: tuple[int, ...]
    dataset: str = "auto"
    data_dir: str | None = None
    seed: int = 0
    situations: SituationConfig = field(default_factory=SituationConfig)
    prices: PriceConfig = field(default_factory=PriceConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    episodes: EpisodeConfig = field(default_factory=EpisodeConfig)


class Workshop:
    """Makes plans and states.

    Args:
        config: Of what.

    Raises:
        HandoverError: The data are not there.
    """

    def __init__(self, config: WorkshopConfig) -> None:
        self._data = open_dataset(config.dataset, config.data_dir, PANDA_CAMERA)
        context = context_of(self._data)
        arm = KinematicArm(context)
        #: Where objects and arms are.
        self.situations = Situations(self._data, config.scenes, arm.arm, context.panda, config.seed, config.situations)
        book = GraspBook(context, config.prices)
        self._expert = Expert(context, book, arm, config.expert)
        names = {_object_of(scene): scene for scene in reversed(config.scenes)}
        self._assets = functools.cache(lambda name: self._assets_of(names[name]))
        physics = OFFICIAL.physics
        self._studio = Studio(arm, self._expert, physics, self._assets, config.episodes, config.expert)
        self._seed = config.seed

    def plan(self, number: int) -> ExpertPlan | None:
        """The expert's plan in a situation."""
        return self._expert.plan(self.situations.draw(number))

    def states(self, numbers: Sequence[int], plans: Sequence[ExpertPlan], policy: Policy | None, turn: int) -> States:
        """The states of an episode of each of some situations.

        Args:
            numbers: Of the situations.
            plans: Of the expert in them.
            policy: Who plays, or None for the expert.
            turn: How manieth time these are played; each time others are met.
        """
        drawn = [self.situations.draw(number) for number in numbers]
        return self._studio.play(drawn, plans, policy, self._seed + 1_000_003 * (turn + 1))

    def _assets_of(self, scene_id: int) -> SceneAssets:
        """The models of a scene with the given object alone."""
        assets = self._data.scene(scene_id).assets
        return replace(assets, objects=assets.objects[:1])


def graspable_scenes(data: Dataset, scenes: Sequence[int]) -> tuple[int, ...]:
    """Scenes whose given object has grasps."""
    known = {name: data.grasps(name) is not None for name in {_object_of(scene) for scene in scenes}}
    return tuple(scene for scene in scenes if known[_object_of(scene)])


def _object_of(scene_id: int) -> str:
    """Class of the given object, from the number alone, which reads no scene: 100 * subject + 5 * object + trial."""
    return CLASS_NAMES[SCENE_CLASSES[scene_id % 100 // 5]]


@functools.lru_cache(maxsize=1)
def workshop_of(config: WorkshopConfig) -> Workshop:
    """The workshop of this process."""
    return Workshop(config)


def made(
    make: Callable[[Workshop, _Task], _Made], config: WorkshopConfig, tasks: Sequence[_Task], pool: PoolConfig
) -> Iterator[tuple[int, _Made]]:
    """Numbers of tasks and their results, as they are finished, in this process or in several.

    Args:
        make: Makes one.
        config: In which workshop.
        tasks: What is to be made.
        pool: Who makes.

    Raises:
        WorkerError: A process died twice over the same task, or the cluster cannot be reached or used.
        DataFormatError: A machine has other data.
    """
    if tasks:
        workers = open_pool(pool)
        workshop = (
            functools.partial(_workshop_away, config, *_marks(config))
            if workers.elsewhere
            else (functools.partial(workshop_of, config))
        )
        job = Job(lambda: nullcontext(functools.partial(make, workshop())), lambda _: "making plans or states")
        yield from answers(workers, job, tasks)


def _marks(config: WorkshopConfig) -> tuple[DataPlace, dict[int, str]]:
    """What another machine needs to find the same data: where they are, and a fingerprint for every object."""
    data = open_dataset(config.dataset, config.data_dir, PANDA_CAMERA)
    some = {_object_of(scene): scene for scene in reversed(config.scenes)}.values()
    return DataPlace.of(config.data_dir), {scene: data.fingerprint(scene) for scene in some}


def _workshop_away(config: WorkshopConfig, place: DataPlace, marks: dict[int, str]) -> Workshop:
    there = replace(config, data_dir=place.here())
    data = open_dataset(there.dataset, there.data_dir, PANDA_CAMERA)
    for scene, mark in marks.items():
        check_scene(scene, data.fingerprint(scene), mark)
    return workshop_of(there)
