"""Generation of the expert's plans and of imitation states, in parallel processes.

Results do not depend on the number of processes. Plans are cached on disk, so that an interrupted
training can be resumed.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from handover_marl.config import OFFICIAL_CONFIG
from handover_marl.datasets import Dataset, open_dataset
from handover_marl.datasets.dataset import SceneAssets
from handover_marl.errors import OptionError, ResultsError
from handover_marl.execution.files import shorten_text, write_arrays
from handover_marl.execution.options import PoolConfig
from handover_marl.execution.reading import read_arrays
from handover_marl.execution.tasks import map_with_progress
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.geometry.ycb import CLASS_NAMES, SCENE_CLASSES
from handover_marl.learning.imitation.gaddpg.expert import ExpertPlan, GraspExpert, GraspExpertConfig, KinematicArm
from handover_marl.learning.imitation.gaddpg.grasp_costs import GraspCostConfig, GraspCostTable
from handover_marl.learning.imitation.gaddpg.rollouts import ImitationRolloutConfig, ImitationRollouts, StepPolicy
from handover_marl.learning.imitation.gaddpg.scenarios import ImitationScenarioConfig, ImitationScenarios
from handover_marl.learning.imitation.gaddpg.states import MAX_STATES_BYTES, ImitationStates, concatenate_states
from handover_marl.policies.policy import make_policy_context

#: Number of plans in a file, and of scenarios in the task of a worker.
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
        scenarios: Distribution of the scenarios.
        costs: Configuration of the costs of grasps.
        expert: Configuration of the expert's selection of grasps.
        rollouts: Configuration of the rollouts.
    """

    scenes: tuple[int, ...]
    dataset: str = "auto"
    data_dir: str | None = None
    seed: int = 0
    scenarios: ImitationScenarioConfig = field(default_factory=ImitationScenarioConfig)
    costs: GraspCostConfig = field(default_factory=GraspCostConfig)
    expert: GraspExpertConfig = field(default_factory=GraspExpertConfig)
    rollouts: ImitationRolloutConfig = field(default_factory=ImitationRolloutConfig)


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
        self._scenarios = ImitationScenarios(
            self._data, config.scenes, arm.arm, context.panda, config.seed, config.scenarios
        )
        self._expert = GraspExpert(context, GraspCostTable(context, config.costs), arm, config.expert)
        scenes = {_object_name_of(scene): scene for scene in reversed(config.scenes)}
        load_assets = functools.cache(lambda name: self._load_assets(scenes[name]))
        self._rollouts = ImitationRollouts(
            arm, self._expert, OFFICIAL_CONFIG.physics, load_assets, config.rollouts, config.expert
        )

    def plan(self, number: int) -> ExpertPlan | None:
        """Return the expert's plan in a scenario by number; None if no grasp is reachable."""
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
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = {first: folder / f"{first:06d}.npz" for first in range(0, count, CHUNK_SIZE)}

    def make_writer() -> Callable[[int], None]:
        generator = DataGenerator(config)

        def write(first: int) -> None:
            found = {number: generator.plan(number) for number in range(first, first + CHUNK_SIZE)}
            _write_plans(paths[first], {number: plan for number, plan in found.items() if plan is not None})

        return write

    missing = [first for first, path in paths.items() if not path.exists()]
    for _ in map_with_progress(make_writer, missing, "plans", PoolConfig(workers), progress=True):
        pass
    found: ExpertPlans = {}
    for path in paths.values():
        found |= _read_plans(path)
    return {number: plan for number, plan in found.items() if number < count}


def collect_states(
    config: DataGeneratorConfig, tasks: Sequence[RolloutTask], weights: Path | None, workers: int | None
) -> ImitationStates:
    """Return the imitation states of all rollouts, in the order of the tasks.

    Args:
        config: Configuration of the data generation.
        tasks: Scenarios of the rollouts, with the expert's plans.
        weights: Weight file of the network that acts; None lets the expert act.
        workers: Number of worker processes; default: one per core.
    """

    def make_collector() -> Callable[[int], ImitationStates]:
        generator, policy = DataGenerator(config), None if weights is None else _load_policy(weights)
        return lambda number: generator.collect_states(tasks[number], policy)

    numbers = range(len(tasks))
    found = dict(map_with_progress(make_collector, numbers, "rollouts", PoolConfig(workers), progress=True))
    return concatenate_states([found[number] for number in numbers])


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


def _write_plans(path: Path, plans: ExpertPlans) -> None:
    arrays: dict[str, npt.NDArray[Any]] = {"numbers": np.array(sorted(plans), dtype=np.int64)}
    for number, plan in plans.items():
        arrays |= {f"{name}_{number}": value for name, value in vars(plan).items()}
    write_arrays(path, arrays)


def _read_plans(path: Path) -> ExpertPlans:
    try:
        arrays = read_arrays(path, largest=MAX_STATES_BYTES)
        return {
            number: ExpertPlan(*(arrays[f"{name}_{number}"] for name in ("goals", "costs", "trajectory")))
            for number in arrays["numbers"].tolist()
        }
    except Exception as error:  # NumPy and zipfile raise exceptions of many types on damaged files
        raise ResultsError(f"{path}: not a file of plans ({shorten_text(error)}); remove it and resume") from error
