"""Train the network of the receiver `gaddpg` by imitation.

The script needs the extras `train`, `planning` and `vision`.

    python experiments/training/train_gaddpg.py --data-dir DIR --out runs/gaddpg

The training follows Wang et al. (CoRL 2021): objects are at rest without a hand, the expert is the planner `omg`, and
the network is trained by behavior cloning with an auxiliary loss of its predicted grasps. In later rounds the network
acts and the expert labels the states (DAgger). Only the validation after each round simulates physics. The folder gets
`gaddpg.npz`, the best network (`--receiver gaddpg:weights=runs/gaddpg/gaddpg.npz --robot panda_camera`), TensorBoard
logs, the expert's plans, the states, and a checkpoint, from which `--resume` continues.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from handover_marl.errors import OptionError
from handover_marl.geometry.panda import PANDA_CAMERA
from handover_marl.learning.imitation.gaddpg.data_generation import DataGenerator, ImitationStates, list_shared_scenes
from handover_marl.learning.imitation.gaddpg.expert import ExpertPlan
from handover_marl.learning.imitation.gaddpg.training import GaddpgLearner, ImitationBatches
from handover_marl.learning.imitation.run import ImitationArgs, ImitationRun, generate_samples, join_samples
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
from handover_marl.learning.networks.weights import read_network_weights
from handover_marl.learning.training.scene_arguments import run_script

# One in this number of planned scenarios gives held-out states.
HELD_OUT_STRIDE = 50


@dataclass(frozen=True)
class Args(ImitationArgs):
    """Arguments of the training of `gaddpg` by imitation.

    Attributes:
        setups: Official setups. The network is trained on the scenes that each of them has in its
            training split, so no test scene is used.
        scenarios: Number of scenarios for which the expert plans.
        rounds: Number of rounds in which the network acts (DAgger), evenly spread over the training.
        episodes: Number of rollouts of each scenario in the first round; later rounds have one.
        repeated_share: Share of the scenarios that have a rollout in each round after the first.
        waits: Initial waiting times (s) of the receiver in evaluations. The mean success rate selects the network.
        spare_steps: Number of decisions that should be left when the receiver's hand reaches a grasp. The expert leaves
            20; with fewer, the approach is slower, since the giver may still move.
        max_steps: Number of decisions of an approach to an object at rest.
    """

    out: str = "runs/gaddpg"
    setups: tuple[str, ...] = ("s0", "s1", "s2", "s3")
    scenarios: int = 2000
    rounds: int = 4
    episodes: int = 2
    repeated_share: float = 0.5
    updates: int = 15_000
    waits: tuple[float, ...] = (3.0,)
    spare_steps: int = 5
    max_steps: int = 30


def main(args: Args) -> Path:
    """Train in all rounds; return the weight file of the network with the highest success rate in validation."""
    args = args.resolve_setup()
    scenes = list_shared_scenes(args.open_dataset(PANDA_CAMERA), args.setups)
    torch.manual_seed(args.seed)
    network = GaddpgNetwork(args.spare_steps, args.max_steps)
    learner = GaddpgLearner(network, args.updates, args.torch_device)
    run = ImitationRun(args, "gaddpg", PANDA_CAMERA, learner)

    def make_generator() -> DataGenerator:
        return DataGenerator(args.open_dataset(PANDA_CAMERA), scenes, args.seed)

    found = generate_samples(
        ExpertPlan, run.folder / "plans", range(args.scenarios), lambda: make_generator().plan, "plans", args.workers
    )
    plans = {number: plan for number, plan in enumerate(found) if len(plan.goals)}
    if not plans:
        raise OptionError("scenarios must have reachable grasps, got none that the expert reaches; plan more of them")

    def load_states(numbers: list[int], repetition: int, weights: Path | None = None) -> ImitationStates:
        """Return the states of rollout `repetition` of the scenarios `numbers`; run rollouts that have no file yet."""

        def make_collector() -> Callable[[int], ImitationStates]:
            generator = make_generator()
            policy = None if weights is None else read_network_weights(weights, GaddpgNetwork)[0].predict_step
            return lambda number: generator.collect_states(number, plans[number], repetition, policy)

        folder = run.folder / "states" / str(repetition)
        return join_samples(
            generate_samples(ImitationStates, folder, numbers, make_collector, "rollouts", args.workers)
        )

    planned = sorted(plans)
    n_held_out = max(1, len(planned) // HELD_OUT_STRIDE)
    held_out, training = planned[:n_held_out], planned[n_held_out:] or planned

    def collect(number: int) -> ImitationStates:
        """Return the states of a round: rollouts of the expert in round 0, of the network in later ones."""
        if number == 0:
            return join_samples([load_states(training, 1 + episode) for episode in range(args.episodes)])
        rng = np.random.default_rng((args.seed, number))
        count = max(1, round(args.repeated_share * len(training)))
        chosen = rng.choice(training, count, replace=False)
        return load_states(sorted(chosen.tolist()), args.episodes + number, run.latest)

    return run.train(
        collect,
        ImitationBatches,
        ImitationBatches(load_states(held_out, 0)),
        [{"wait": wait} for wait in args.waits],
        args.rounds,
    )


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
