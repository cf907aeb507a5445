"""Train the network of the receiver `gaddpg` by imitation.

The script needs the extras `train`, `planning` and `vision`.

    python experiments/training/train_gaddpg.py --data-dir DIR --out runs/gaddpg

The training follows Wang et al. (CoRL 2021): objects are at rest without a hand, the expert is the planner
`omg`, and the network is trained by behavior cloning with an auxiliary loss of goals. In later rounds the
network acts and the expert labels the states (DAgger). Only the evaluation on the validation split simulates physics.
The folder gets `gaddpg.npz`, the best network (`--receiver gaddpg:weights=runs/gaddpg/gaddpg.npz
--robot panda_camera`), TensorBoard logs, the expert's plans, the states, and a checkpoint, from which `--resume`
continues.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.progress import track

from handover_marl.errors import OptionError
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.learning.imitation.gaddpg.batches import ImitationBatches, StateAugmentationConfig
from handover_marl.learning.imitation.gaddpg.data_generation import (
    CHUNK_SIZE,
    DataGeneratorConfig,
    ExpertPlans,
    RolloutTask,
    collect_states,
    list_shared_scenes,
    make_plans,
)
from handover_marl.learning.imitation.gaddpg.expert import GraspExpertConfig
from handover_marl.learning.imitation.gaddpg.grasp_costs import GraspCostConfig
from handover_marl.learning.imitation.gaddpg.learner import GaddpgLearner, GaddpgLearnerConfig
from handover_marl.learning.imitation.gaddpg.rollouts import ImitationRolloutConfig
from handover_marl.learning.imitation.gaddpg.scenarios import ImitationScenarioConfig
from handover_marl.learning.imitation.gaddpg.states import (
    ImitationStates,
    concatenate_states,
    read_states,
    write_states,
)
from handover_marl.learning.imitation.run import ImitationArgs, ImitationRun
from handover_marl.learning.networks.approach_field import ApproachFieldConfig

# Updates between two records of losses, and between two checkpoints; held-out states per record.
LOSS_INTERVAL, CHECKPOINT_INTERVAL, N_HELD_OUT = 50, 500, 256
# Index of the repetition that gives held-out states, and first one of training rollouts.
HELD_OUT_REPETITION, FIRST_REPETITION = 99, 1000
# One of so many planned scenarios gives held-out states.
HELD_OUT_STRIDE = 50


@dataclass(frozen=True)
class Args(ImitationArgs):
    """Arguments of the training of `gaddpg` by imitation.

    Attributes:
        setups: Official setups; the network is trained on scenes that are in the training splits of
            all these setups, so that no test scene is used.
        val_setup: Setup whose validation split selects the network.
        scenarios: Number of scenarios for which the expert plans.
        episodes: Number of rollouts of each scenario in the first round; one in later rounds.
        repeated_share: Share of the scenarios that have a rollout in each round after the first.
        batch_size: Number of states per update.
        waits: Initial waiting times (s) of the receiver in evaluations; their mean success rate
            selects the network.
        threads: Number of threads of PyTorch.
        device: PyTorch device: cpu, cuda, or auto.
        scenario: Distribution of the scenarios.
        costs: Costs by which the expert ranks grasps.
        expert: Configuration of the expert's choice of goal grasps.
        rollout: Configuration of the rollouts.
        augment: Configuration of the data augmentation.
        learner: Hyperparameters of the network's training.
        approach: Configuration of the network's approach to a grasp; slower than the expert's,
            since the giver may still move.
        max_steps: Largest number of actions in the network's approach to a grasp.
    """

    out: str = "runs/gaddpg"
    setups: tuple[str, ...] = ("s0", "s1", "s2", "s3")
    val_setup: str = "s0"
    scenarios: int = 2000
    rounds: int = 4
    episodes: int = 2
    repeated_share: float = 0.5
    updates: int = 15_000
    batch_size: int = 64
    waits: tuple[float, ...] = (3.0,)
    threads: int = 2
    device: str = "auto"
    scenario: ImitationScenarioConfig = field(default_factory=ImitationScenarioConfig)
    costs: GraspCostConfig = field(default_factory=GraspCostConfig)
    expert: GraspExpertConfig = field(default_factory=GraspExpertConfig)
    rollout: ImitationRolloutConfig = field(default_factory=ImitationRolloutConfig)
    augment: StateAugmentationConfig = field(default_factory=StateAugmentationConfig)
    learner: GaddpgLearnerConfig = field(default_factory=GaddpgLearnerConfig)
    approach: ApproachFieldConfig = field(default_factory=lambda: ApproachFieldConfig(spare_steps=5))
    max_steps: int = 30

    def __post_init__(self) -> None:
        for name in ("scenarios", "episodes", "updates", "batch_size", "threads", "max_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.waits:
            raise OptionError("waits must contain at least one waiting time, got none")


def load_states(
    args: Args, run: ImitationRun, generator: DataGeneratorConfig, tasks: list[RolloutTask], name: str, acts: bool
) -> ImitationStates:
    """Return the states of rollouts from their file; collect them if the file is missing.

    Args:
        args: Arguments of the training.
        run: Training run.
        generator: Configuration of the generation of states.
        tasks: Scenarios of the rollouts.
        name: Name of the file.
        acts: Whether the network acts, and not the expert.
    """
    path = run.folder / "states" / f"{name}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_states(path, collect_states(generator, tasks, run.latest if acts else None, args.workers))
    return read_states(path)


def make_tasks(args: Args, plans: ExpertPlans, number: int) -> list[RolloutTask]:
    """Return the rollouts of a round: of the expert in the first one, of the network in later ones."""
    numbers = sorted(plans)[max(1, len(plans) // HELD_OUT_STRIDE) :] or sorted(plans)
    repetitions = [number] if number > 0 else [-1 - episode for episode in range(args.episodes)]
    if number > 0:
        rng = np.random.default_rng((args.seed, number))
        chosen = rng.choice(numbers, max(1, round(args.repeated_share * len(numbers))), replace=False)
        numbers = sorted(chosen.tolist())
    chunks = [numbers[first : first + CHUNK_SIZE] for first in range(0, len(numbers), CHUNK_SIZE)]
    return [
        RolloutTask(chunk, [plans[number] for number in chunk], FIRST_REPETITION + repetition)
        for repetition in repetitions
        for chunk in chunks
    ]


def train(
    args: Args, learner: GaddpgLearner, run: ImitationRun, states: ImitationStates, held_out: ImitationStates, end: int
) -> None:
    """Run the gradient updates of a round; log losses of the batches and on held-out states."""
    torch.set_num_threads(args.threads)
    batches, others = (ImitationBatches(each, args.expert.approach, args.augment) for each in (states, held_out))
    some = np.random.default_rng(0).permutation(len(held_out))[:N_HELD_OUT]
    for done in track(range(learner.done + 1, end + 1), description=f"updates up to {end}"):
        # Seeded by the number of the update, so that a resumed run continues exactly.
        rng = np.random.default_rng((args.seed, learner.done))
        losses = learner.update(batches.select(rng.integers(len(states), size=args.batch_size), rng))
        if done % LOSS_INTERVAL == 0 or done == end:
            held_out_losses = learner.evaluate(others.select(some, None))
            for name, value in losses.items():
                run.writer.add_scalar(f"train/{name}", value, done)
                run.writer.add_scalar(f"held_out/{name}", held_out_losses[name], done)
        if done % CHECKPOINT_INTERVAL == 0:
            run.save()


def main(args: Args) -> Path:
    """Train in all rounds; return the path of the best network's weights."""
    torch.set_num_threads(args.threads)
    data = args.open_dataset(PANDA_CAMERA)
    scenes = list_shared_scenes(data, args.setups)
    device = ("cuda" if torch.cuda.is_available() else "cpu") if args.device == "auto" else args.device
    learner = GaddpgLearner(args.updates, args.seed, torch.device(device), args.learner, args.approach, args.max_steps)
    free = ("threads", "device")
    run = ImitationRun(args, "gaddpg", args.val_setup, PANDA_CAMERA, learner.get_state, learner.restore, free)
    generator = DataGeneratorConfig(
        scenes, data.name, args.data_dir, args.seed, args.scenario, args.costs, args.expert, args.rollout
    )
    plans = make_plans(run.folder / "plans", generator, args.scenarios, args.workers)
    if not plans:
        raise OptionError("the expert can reach no grasp in any scenario")
    numbers = sorted(plans)[: max(1, len(plans) // HELD_OUT_STRIDE)]
    task = RolloutTask(numbers, [plans[number] for number in numbers], HELD_OUT_REPETITION)
    held_out = load_states(args, run, generator, [task], "held", False)
    states: list[ImitationStates] = []
    for number, end in enumerate(args.update_counts):
        tasks = make_tasks(args, plans, number)
        states.append(load_states(args, run, generator, tasks, f"round-{number}", number > 0))
        if learner.done < end:
            train(args, learner, run, concatenate_states(states), held_out, end)
            run.evaluate(learner.averaged, learner.done, [{"wait": wait} for wait in args.waits])
    run.writer.close()
    return run.best


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
