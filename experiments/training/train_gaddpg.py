"""Train the network of the receiver `gaddpg` by imitation.

The script needs the extras `train`, `planning` and `vision`.

    python experiments/training/train_gaddpg.py --data-dir DIR --out runs/gaddpg

The training follows Wang et al. (CoRL 2021): objects are at rest without a hand, the expert is the planner `omg`, and
the network is trained by behavior cloning with an auxiliary loss of goals. In later rounds the network acts and the
expert labels the states (DAgger). Only the evaluation on the validation split simulates physics. The folder gets
`gaddpg.npz`, the best network (`--receiver gaddpg:weights=runs/gaddpg/gaddpg.npz --robot panda_camera`), TensorBoard
logs, the expert's plans, the states, and a checkpoint, from which `--resume` continues.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from handover_marl.errors import OptionError
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.learning.imitation.gaddpg.data_generation import (
    CHUNK_SIZE,
    DataGeneratorConfig,
    ExpertPlans,
    ImitationStates,
    RolloutTask,
    collect_states,
    list_shared_scenes,
    make_plans,
)
from handover_marl.learning.imitation.gaddpg.training import GaddpgLearner, ImitationBatches
from handover_marl.learning.imitation.run import ImitationArgs, ImitationRun
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
from handover_marl.learning.training.scene_arguments import run_script

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
        rounds: Number of rounds in which the network acts (DAgger), evenly spread over the training.
        episodes: Number of rollouts of each scenario in the first round; one in later rounds.
        repeated_share: Share of the scenarios that have a rollout in each round after the first.
        waits: Initial waiting times (s) of the receiver in evaluations; their mean success rate selects the network.
        spare_steps: Number of decisions that should be left when the hand reaches a grasp. The expert's 20 are the
            fastest approach; fewer make it slower, since the giver may still move.
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
    waits: tuple[float, ...] = (3.0,)
    spare_steps: int = 5
    max_steps: int = 30

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("scenarios", "episodes", "max_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.waits:
            raise OptionError("waits must contain at least one waiting time, got none")


def make_tasks(args: Args, plans: ExpertPlans, number: int) -> list[RolloutTask]:
    """Return the rollouts of the round `number`: of the expert in round 0, of the network in later ones."""
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


def main(args: Args) -> Path:
    """Train in all rounds; return the weight file of the network with the highest success on the validation split."""
    data = args.open_dataset(PANDA_CAMERA)
    scenes = list_shared_scenes(data, args.setups)
    torch.manual_seed(args.seed)
    network = GaddpgNetwork(args.spare_steps, args.max_steps)
    learner = GaddpgLearner(network, args.updates, args.torch_device)
    run = ImitationRun(args, "gaddpg", args.val_setup, PANDA_CAMERA, learner)
    generator = DataGeneratorConfig(scenes, data.name, args.data_dir, args.seed)
    plans = make_plans(run.folder / "plans", generator, args.scenarios, args.workers)

    def load_states(tasks: list[RolloutTask], name: str, weights: Path | None = None) -> ImitationStates:
        return collect_states(run.folder / "states" / name, generator, tasks, weights, args.workers)

    numbers = sorted(plans)[: max(1, len(plans) // HELD_OUT_STRIDE)]
    held_out = load_states([RolloutTask(numbers, [plans[number] for number in numbers], HELD_OUT_REPETITION)], "held")
    return run.train(
        lambda number: load_states(make_tasks(args, plans, number), f"round_{number}", run.latest if number else None),
        ImitationBatches,
        ImitationBatches(held_out),
        [{"wait": wait} for wait in args.waits],
        args.rounds,
    )


if __name__ == "__main__":
    print(run_script(main, Args))
