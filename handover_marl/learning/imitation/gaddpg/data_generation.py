"""Generation of the expert's plans and of imitation states, in parallel processes.

Results do not depend on the number of processes. Plans are cached on disk, so that an interrupted
training can be resumed.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import OptionError
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES
from handover_marl.learning.imitation.gaddpg.expert import ExpertPlan, GraspExpert, GraspExpertConfig, KinematicArm
from handover_marl.learning.imitation.gaddpg.rollouts import ImitationRollouts, StepPolicy
from handover_marl.learning.imitation.gaddpg.scenarios import ImitationScenarios
from handover_marl.learning.imitation.gaddpg.states import ImitationStates
from handover_marl.learning.imitation.samples import generate_samples, join_samples
from handover_marl.policies.policy import make_policy_context

#: Number of scenarios in the task of a worker, and in a file of states.
CHUNK_SIZE = 16

ExpertPlans = dict[int, ExpertPlan]


@dataclass(frozen=True)
class DataGeneratorConfig:
    """Configuration of the generation of imitation data.

    Attributes:
        scenes: Numbers of the training scenes.
        dataset: Dataset: dexycb, synthetic, or auto.
        data_dir: Folder in HandoverSim's layout.
        seed: Seed of all random numbers.
        expert: Configuration of the expert's selection of grasps.
    """

    scenes: tuple[int, ...]
    dataset: str = "auto"
    data_dir: str | None = None
    seed: int = 0
    expert: GraspExpertConfig = field(default_factory=GraspExpertConfig)


class RolloutTask(NamedTuple):
    """Task of a worker: imitation rollouts of some scenarios.

    Attributes:
        numbers: Numbers of the scenarios.
        plans: Plans of the expert in these scenarios.
        repetition: Index of the repetition of the rollouts, which seeds the random numbers.
    """

    numbers: list[int]
    plans: list[ExpertPlan]
    repetition: int


class DataGenerator:
    """Generator of the expert's plans and of imitation states in one process.

    Args:
        config: Configuration of the data generation.

    Raises:
        HandoverError: The dataset cannot be opened.
    """

    def __init__(self, config: DataGeneratorConfig) -> None:
        self._data, self._seed = open_dataset(config.dataset, config.data_dir, PANDA_CAMERA), config.seed
        context = make_policy_context(self._data)
        arm = KinematicArm(context)
        self._scenarios = ImitationScenarios(self._data, config.scenes, arm.arm, context.panda, config.seed)
        self._expert = GraspExpert(context, arm, config.expert)
        scenes = {_object_name_of(scene): scene for scene in reversed(config.scenes)}
        load_assets = functools.cache(lambda name: self._load_assets(scenes[name]))
        self._rollouts = ImitationRollouts(arm, self._expert, OFFICIAL_CONFIG.physics, load_assets)

    def plan(self, number: int) -> ExpertPlan:
        """Return the expert's plan in a scenario by number, without goals if no grasp is reachable."""
        return self._expert.plan(self._scenarios.sample(number))

    def collect_states(self, task: RolloutTask, policy: StepPolicy | None) -> ImitationStates:
        """Return the imitation states of one rollout of each scenario of a task.

        Args:
            task: Scenarios with plans.
            policy: Network's policy, or None for rollouts of the expert.
        """
        scenarios = [self._scenarios.sample(number) for number in task.numbers]
        return self._rollouts.run(scenarios, task.plans, policy, self._seed + 1_000_003 * (task.repetition + 1))

    def _load_assets(self, scene_id: int) -> SceneAssets:
        """Return the models of a scene with the handed-over object only."""
        assets = self._data.load_scene(scene_id).assets
        return replace(assets, objects=assets.objects[:1])


def list_shared_scenes(data: Dataset, setups: Sequence[str]) -> tuple[int, ...]:
    """Return the scenes in the training splits of all given setups whose object has known grasps.

    Raises:
        OptionError: There are no such scenes.
    """
    common = set.intersection(*(set(data.list_scenes(setup, "train")) for setup in setups)) if setups else set[int]()
    has_grasps = {name: data.load_grasps(name) is not None for name in {_object_name_of(scene) for scene in common}}
    scenes = tuple(scene for scene in sorted(common) if has_grasps[_object_name_of(scene)])
    if not scenes:
        raise OptionError(f"setups must share training scenes with known grasps, got {list(setups)}")
    return scenes


def make_plans(folder: Path, config: DataGeneratorConfig, count: int, workers: int | None) -> ExpertPlans:
    """Return the expert's plans in scenarios 0 to `count` - 1; compute those that are not on disk.

    Scenarios without a reachable grasp are left out.

    Args:
        folder: Folder of the files of plans, for one configuration only.
        config: Configuration of the data generation.
        count: Number of scenarios.
        workers: Number of worker processes; default: one per core.

    Raises:
        ResultsError: A file is damaged or cannot be written.
        OptionError: No grasp is reachable in any scenario.
    """
    found = generate_samples(ExpertPlan, folder, range(count), lambda: DataGenerator(config).plan, "plans", workers)
    plans = {number: plan for number, plan in enumerate(found) if len(plan.goals)}
    if not plans:
        raise OptionError("the expert can reach no grasp in any scenario")
    return plans


def collect_states(
    folder: Path, config: DataGeneratorConfig, tasks: Sequence[RolloutTask], weights: Path | None, workers: int | None
) -> ImitationStates:
    """Return the imitation states of all rollouts, in the order of the tasks; collect those that are not on disk.

    Args:
        folder: Folder of the files of states, for the same configuration and tasks only.
        config: Configuration of the data generation.
        tasks: Scenarios of the rollouts, with the expert's plans.
        weights: Weight file of the network that acts; None lets the expert act.
        workers: Number of worker processes; default: one per core.
    """

    def make_collector() -> Callable[[int], ImitationStates]:
        generator, policy = DataGenerator(config), None if weights is None else _load_policy(weights)
        return lambda number: generator.collect_states(tasks[number], policy)

    numbers = range(len(tasks))
    return join_samples(generate_samples(ImitationStates, folder, numbers, make_collector, "rollouts", workers))


def _load_policy(weights: Path) -> StepPolicy:
    # Imports PyTorch, which planning does not need.
    import torch

    from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
    from handover_marl.learning.networks.weights import read_network_weights

    torch.set_num_threads(1)
    return read_network_weights(weights, GaddpgNetwork)[0].predict_steps


def _object_name_of(scene_id: int) -> str:
    """Return the class of the handed-over object; scenes are numbered 100 subject + 5 object + trial."""
    return CLASS_NAMES[SCENE_CLASSES[scene_id % 100 // 5]]
