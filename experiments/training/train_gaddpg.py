"""Train the network of the receiver `gaddpg` by imitation.

The script needs the extras `train`, `planning` and `vision`.

    python experiments/training/train_gaddpg.py --data-dir DIR --out runs/gaddpg

The training follows Wang et al. (CoRL 2021): objects are at rest without a hand, the expert is the planner
`omg`, and the network is trained by behavior cloning with an auxiliary loss of goals. In later rounds the
network acts and the expert labels the states (DAgger). Only the evaluation on the validation split simulates physics.
The folder gets `policy.npz`, the best network (`--receiver gaddpg:weights=runs/gaddpg/policy.npz
--robot panda_camera`), `last.npz`, TensorBoard logs, `plans/`, `states/`, and a checkpoint, from which `--resume`
continues.
"""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.progress import Progress
from torch.utils.tensorboard import SummaryWriter

from handover_marl.datasets import open_dataset
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.errors import OptionError
from handover_marl.evaluation.benchmark import evaluate_pair
from handover_marl.evaluation.config import EvaluationConfig, ExecutionConfig
from handover_marl.execution.options import LOCAL
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
from handover_marl.learning.networks.approach_field import ApproachFieldConfig
from handover_marl.learning.networks.weights import write_network_weights
from handover_marl.learning.training.run_folder import (
    CHECKPOINT,
    OUTCOMES,
    POLICY,
    describe_origin,
    open_run_folder,
    read_checkpoint,
    summarize_evaluation,
    write_checkpoint,
)
from handover_marl.learning.training.scene_arguments import DatasetArgs

LAST = "last.npz"
# Updates between two records of losses, and between two checkpoints; held-out states per record.
LOSS_INTERVAL, CHECKPOINT_INTERVAL, N_HELD_OUT = 50, 500, 256
# Index of the repetition that gives held-out states, and first one of training rollouts.
HELD_OUT_REPETITION, FIRST_REPETITION = 99, 1000
# Arguments that may change when a run is resumed.
FREE = ("workers", "backend", "ray_address", "threads", "device")


@dataclass(frozen=True)
class Args(DatasetArgs):
    """Arguments of the training of `gaddpg` by imitation.

    Attributes:
        out: Folder of the run.
        setups: Official setups; the network is trained on scenes that are in the training splits of
            all these setups, so that no test scene is used.
        val_setup: Setup whose validation split selects the network.
        seed: Seed of all random numbers.
        scenarios: Number of scenarios for which the expert plans.
        rounds: Number of rounds: rollouts of the expert in the first, of the network in the others.
        episodes: Number of rollouts of each scenario in the first round; one in later rounds.
        repeated_share: Share of the scenarios that have a rollout in each round after the first.
        updates: Total number of gradient updates.
        batch_size: Number of states per update.
        val_scenes: Number of validation scenes, evenly chosen.
        waits: Initial waiting times (s) of the receiver in evaluations; their mean success rate
            selects the network.
        minutes: Wall-clock time (min) after which the script stops; the run can be resumed.
        workers: Number of worker processes.
        backend: Location of the worker processes: local, or ray for the nodes of a Ray cluster.
        ray_address: Address of the Ray cluster; default: a running one.
        threads: Number of threads of PyTorch.
        device: PyTorch device: cpu, cuda, or auto.
        resume: Whether to continue the run in the folder `out`.
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
    seed: int = 0
    scenarios: int = 2000
    rounds: int = 5
    episodes: int = 2
    repeated_share: float = 0.5
    updates: int = 15_000
    batch_size: int = 64
    val_scenes: int = 36
    waits: tuple[float, ...] = (3.0,)
    minutes: float = 600.0
    workers: int = 2
    backend: str = LOCAL
    ray_address: str | None = None
    threads: int = 2
    device: str = "auto"
    resume: bool = False
    scenario: ImitationScenarioConfig = field(default_factory=ImitationScenarioConfig)
    costs: GraspCostConfig = field(default_factory=GraspCostConfig)
    expert: GraspExpertConfig = field(default_factory=GraspExpertConfig)
    rollout: ImitationRolloutConfig = field(default_factory=ImitationRolloutConfig)
    augment: StateAugmentationConfig = field(default_factory=StateAugmentationConfig)
    learner: GaddpgLearnerConfig = field(default_factory=GaddpgLearnerConfig)
    approach: ApproachFieldConfig = field(default_factory=lambda: ApproachFieldConfig(spare_steps=5))
    max_steps: int = 30


class Training:
    """Training run of the network of `gaddpg`.

    Args:
        args: Arguments of the training.
    """

    def __init__(self, args: Args) -> None:
        check_arguments(args)
        torch.set_num_threads(args.threads)
        data = open_dataset(args.dataset, args.data_dir, PANDA_CAMERA)
        scenes = list_shared_scenes(data, args.setups)
        self._args, self._card = args, {"made by": describe_origin("train_gaddpg", args)}
        self._folder = open_run_folder(Path(args.out), args, args.resume, data.name, FREE)
        self._generator = DataGeneratorConfig(
            scenes, data.name, args.data_dir, args.seed, args.scenario, args.costs, args.expert, args.rollout
        )
        self._execution = ExecutionConfig(args.workers, args.backend, args.ray_address, progress=False)
        self._val = select_scenes_evenly(data.list_scenes(args.val_setup, "val"), args.val_scenes)
        device = ("cuda" if torch.cuda.is_available() else "cpu") if args.device == "auto" else args.device
        self._learner = GaddpgLearner(
            args.updates, args.seed, torch.device(device), args.learner, args.approach, args.max_steps
        )
        self._round, self._best, self._started = 0, -1.0, time.monotonic()
        if args.resume and (self._folder / CHECKPOINT).exists():
            read_checkpoint(self._folder / CHECKPOINT, self._restore)

    def run(self) -> Path:
        """Train until all rounds are done or time is up; return the path of the best network."""
        args, pool = self._args, self._execution
        with Progress() as bar, SummaryWriter(str(self._folder / "tensorboard")) as writer:
            task = bar.add_task("plans", total=args.scenarios)
            plans = make_plans(
                self._folder / "plans", self._generator, args.scenarios, pool, lambda n: bar.advance(task, n)
            )
            if not plans:
                raise OptionError("the expert can reach no grasp in any scenario")
            held_out = self._load_held_out_states(plans)
            while self._round < args.rounds and not self.is_out_of_time():
                states = concatenate_states([self._load_states(plans, n, bar) for n in range(self._round + 1)])
                writer.add_scalar("states", len(states), self._learner.done)
                if not self._train(states, held_out, bar, writer):
                    break
                self._round += 1
                self._evaluate(writer)
        return self._folder / POLICY

    def is_out_of_time(self) -> bool:
        """Return whether the time limit of the training is reached."""
        return time.monotonic() - self._started > 60.0 * self._args.minutes

    def _load_held_out_states(self, plans: ExpertPlans) -> ImitationStates:
        """Return the expert's states in scenarios that are not trained on."""
        path = self._states_path("held")
        if not path.exists():
            numbers = sorted(plans)[: max(1, len(plans) // 50)]
            task = RolloutTask(numbers, [plans[number] for number in numbers], HELD_OUT_REPETITION)
            write_states(path, collect_states(self._generator, [task], None, self._execution))
        return read_states(path)

    def _load_states(self, plans: ExpertPlans, number: int, bar: Progress) -> ImitationStates:
        """Return the states of a round from its file; collect them if the file is missing."""
        path = self._states_path(f"round-{number}")
        if not path.exists():
            weights = None
            if number > 0:
                last = self._folder / LAST
                write_network_weights(last, self._learner.averaged, self._card)
                # Workers may be on machines that do not share the folder.
                weights = last.read_bytes()
            tasks = self._make_tasks(plans, number)
            task = bar.add_task(f"rollouts, round {number}", total=len(tasks))
            states = collect_states(self._generator, tasks, weights, self._execution, lambda: bar.advance(task))
            write_states(path, states)
        return read_states(path)

    def _make_tasks(self, plans: ExpertPlans, number: int) -> list[RolloutTask]:
        args = self._args
        numbers = sorted(plans)[max(1, len(plans) // 50) :] or sorted(plans)
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

    def _train(self, states: ImitationStates, held_out: ImitationStates, bar: Progress, writer: SummaryWriter) -> bool:
        """Run the gradient updates of a round; return whether all were run in time."""
        args, learner = self._args, self._learner
        torch.set_num_threads(args.threads)
        batches = ImitationBatches(states, args.expert.approach, args.augment)
        held_out_batches = ImitationBatches(held_out, args.expert.approach, args.augment)
        last = args.updates * (self._round + 1) // args.rounds
        task = bar.add_task(f"updates, round {self._round}", total=last, completed=learner.done)
        while learner.done < last:
            # Seeded by the number of the update, so that a resumed run continues exactly.
            rng = np.random.default_rng((args.seed, learner.done))
            losses = learner.update(batches.select(rng.integers(len(states), size=args.batch_size), rng))
            if learner.done % LOSS_INTERVAL == 0 or learner.done == last:
                some = np.random.default_rng(0).permutation(len(held_out))[:N_HELD_OUT]
                held_out_losses = learner.evaluate(held_out_batches.select(some, None))
                for name, value in losses.items():
                    writer.add_scalar(f"train/{name}", value, learner.done)
                    writer.add_scalar(f"held_out/{name}", held_out_losses[name], learner.done)
            if learner.done % CHECKPOINT_INTERVAL == 0:
                self._save()
                if self.is_out_of_time():
                    return False
            bar.update(task, completed=learner.done)
        return True

    def _evaluate(self, writer: SummaryWriter) -> None:
        """Evaluate on the validation split, and keep the network if it is the best so far."""
        args, path, steps = self._args, self._folder / LAST, self._learner.done
        write_network_weights(path, self._learner.averaged, self._card)
        successes = []
        for wait in args.waits:
            config = EvaluationConfig(
                args.val_setup,
                "val",
                self._val,
                args.dataset,
                args.data_dir,
                "fast",
                receiver=("gaddpg", {"weights": str(path), "wait": wait}),
                robot=PANDA_CAMERA,
            )
            report = evaluate_pair(config, execution=self._execution)
            print(summarize_evaluation(report, f"{steps} gradient updates, wait {wait:g} s"), flush=True)
            successes.append(report.success_rate)
            for name in OUTCOMES:
                writer.add_scalar(f"evaluation/{name} wait {wait:g}", getattr(report, f"{name}_rate"), steps)
        if float(np.mean(successes)) > self._best:
            self._best = float(np.mean(successes))
            write_network_weights(self._folder / POLICY, self._learner.averaged, self._card)
        self._save()

    def _save(self) -> None:
        state = {"learner": self._learner.get_state(), "round": self._round, "best": self._best}
        write_checkpoint(self._folder / CHECKPOINT, state)

    def _restore(self, state: dict[str, Any]) -> None:
        self._learner.restore(state["learner"])
        self._round, self._best = int(state["round"]), float(state["best"])

    def _states_path(self, name: str) -> Path:
        path = self._folder / "states" / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def check_arguments(args: Args) -> None:
    """Check that all numeric arguments are in range.

    Raises:
        OptionError: A number is out of its range.
    """
    for name in ("scenarios", "rounds", "episodes", "updates", "batch_size", "workers", "threads", "max_steps"):
        if getattr(args, name) < 1:
            raise OptionError(f"{name} must be at least 1, got {getattr(args, name)}")
    if not args.waits:
        raise OptionError("waits must contain at least one waiting time, got none")


def main(args: Args) -> Path:
    return Training(args).run()


if __name__ == "__main__":
    print(main(tyro.cli(Args)))
