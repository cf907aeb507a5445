r"""Train a receiver to imitate another one by DAgger (Ross, Gordon and Bagnell, AISTATS 2011).

    python experiments/training/train_ppo.py --data-dir DIR --partner replay --control-period 0.1 \
        --discount 0.95 --decisions 30000 --out runs/servo.npz
    python experiments/training/train_receiver_dagger.py --data-dir DIR --expert learned:runs/servo.npz \
        --out runs/dagger

In each round, batches of episodes are simulated together, with random disturbances. In the first round the expert acts.
In later rounds the network acts first. The expert takes over at a random time, or when the network closes the gripper.
Decisions of the expert are recorded, and a new network is trained on those of all rounds after each round. The network
maps features to the outputs of an action scheme, such as motions of the gripper, without a script. The folder gets
`policy.npz` (`--receiver learned:runs/dagger/policy.npz`), from which `train_ppo.py --initial` starts;
`--resume` continues a run.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

import handover_marl
from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError
from handover_marl.grasps.selector import LowestCostGraspSelector
from handover_marl.learning.encodings.action_scheme import InvertibleScheme
from handover_marl.learning.encodings.registry import make_array_features, make_array_scheme
from handover_marl.learning.imitation.run import generate_samples, join_samples
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, read_policy, write_policy
from handover_marl.learning.training.run_folder import (
    POLICY,
    describe_origin,
    fit_network,
    make_mlp,
    open_run_folder,
    spawn_seeds,
    validate,
)
from handover_marl.learning.training.scene_arguments import SetupArgs, run_script
from handover_marl.policies.batch import make_policy_batch
from handover_marl.policies.policy import make_policy_context
from handover_marl.policies.reference import parse_policy


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training of a receiver by imitation.

    Attributes:
        out: Folder of the run.
        seed: Seed of all random numbers.
        expert: Receiver to imitate, with a constant control period. Its actions should depend on little more than the
            features: a network learns the mean of the actions in states with equal features.
        giver: Giver of all episodes. With `replay`, networks overfit to the recorded motions.
        features: Features of the receiver, inputs of the network.
        action_scheme: Action scheme that decodes the network's outputs; it must be invertible.
        rounds: Number of rounds.
        batches: Number of batches of episodes in a round.
        num_envs: Number of environments in a batch.
        seconds: Time that each environment of a batch is simulated (s).
        disturbance: Standard deviation of the disturbances of the outputs that move the arm.
        disturbed_share: Share of the decisions that are disturbed.
        latest_takeover: Largest time at which the expert takes over (s).
        change_weight: Weight of the few decisions in which the expert opens or closes the gripper; others have the
            weight 1.
        closing_margin: Output above which the network in `policy.npz` closes the gripper. With 0, networks often close
            it too early, because of the large `change_weight`.
        width: Width of the two hidden layers of the network.
        epochs: Number of times that each training of the network goes through the decisions.
        batch_size: Number of decisions per gradient step.
        learning_rate: Learning rate of AdamW at the start; it decays to zero.
        weight_decay: Weight decay of AdamW.
        val_scenes: Number of validation scenes in the evaluation after each round, evenly chosen; 0 skips it.
        val_physics: Physics of the evaluations: fast, exact or mujoco.
        workers: Number of processes; the results do not depend on it.
        resume: Whether to continue the run in the folder `out`.
    """

    out: Path = Path("runs/dagger")
    seed: int = 0
    expert: str = "learned:runs/servo.npz"
    giver: str = "displaced"
    features: str = "grasp_velocity"
    action_scheme: str = "cartesian_delta"
    rounds: int = 5
    batches: int = 8
    num_envs: int = 64
    seconds: float = 20.0
    disturbance: float = 0.3
    disturbed_share: float = 0.1
    latest_takeover: float = 6.0
    change_weight: float = 20.0
    closing_margin: float = 0.6
    width: int = 512
    epochs: float = 26.0
    batch_size: int = 512
    learning_rate: float = 1e-3
    weight_decay: float = 0.01
    val_scenes: int = 36
    val_physics: str = "mujoco"
    workers: int = 2
    resume: bool = False


class Decisions(NamedTuple):
    """Decisions of n control periods.

    Attributes:
        features: Features (n, k) of the observations.
        outputs: Outputs (n, m) that the action scheme decodes to the expert's actions.
        is_change: Whether the expert opens or closes the gripper, (n,).
    """

    features: np.ndarray
    outputs: np.ndarray
    is_change: np.ndarray


class Collector:
    """Collector of the expert's decisions from a batch of environments.

    Args:
        args: Arguments of the training.
        period: Control period of the expert (s).
    """

    def __init__(self, args: Args, period: float) -> None:
        self._args, self._period, self._has_student = args, period, False
        count, dataset, self._rows = args.num_envs, args.open_dataset(), np.arange(args.num_envs)
        reference = parse_policy("receiver", args.expert)
        self._envs = handover_marl.vector_env(
            count,
            "receiver",
            args.giver,
            autoreset="same_step",
            control_period=period,
            threads=1,
            **args.scene_options,
        )
        context = self._context = make_policy_context(dataset, setup=args.setup)
        selector = LowestCostGraspSelector(context, count)
        self._features = make_array_features("receiver", args.features, context, selector, count)
        scheme = make_array_scheme("receiver", args.action_scheme, context, selector, count)
        if not isinstance(scheme, InvertibleScheme):
            raise OptionError(f"action_scheme must be invertible, got {args.action_scheme!r}")
        self._scheme = scheme
        self._expert = make_policy_batch(reference, dataset, OFFICIAL_CONFIG, args.setup, count)
        self._is_student, self._is_closed = np.zeros(count, bool), np.zeros(count, bool)
        self._takeovers = np.zeros(count)

    def collect(self, number: int, batch: int, student: DenseNetwork | None) -> Decisions:
        """Simulate a batch of a round, and return the expert's decisions.

        Args:
            number: Number of the round.
            batch: Number of the batch.
            student: Network that acts until the expert takes over; None: the expert always acts.
        """
        args, parts = self._args, []
        self._has_student, rng = student is not None, np.random.default_rng((args.seed, number, batch))
        seeds = spawn_seeds(args.num_envs, args.seed, number, batch)
        observation, _ = self._envs.reset(seed=seeds)
        for row in self._rows.tolist():
            self._start(row, observation, rng)
        for _ in range(round(args.seconds / self._period)):
            vectors = self._features(self._rows, observation)
            outputs = np.zeros((args.num_envs, self._scheme.size), np.float32)
            if student is not None:
                outputs[:] = student(vectors)
                self._is_student &= (outputs[:, -1] <= 0.0) & (observation["time"][:, 0] < self._takeovers)
            rows = np.flatnonzero(~self._is_student)
            is_change = np.zeros(0, bool)
            if len(rows):
                outputs[rows], is_change = self._ask_expert(rows, observation)
            parts.append(Decisions(vectors[rows], outputs[rows], is_change))
            noise = args.disturbance * rng.standard_normal(outputs.shape)
            noise *= rng.random((args.num_envs, 1)) < args.disturbed_share
            noise[:, -1] = 0.0  # the gripper is not disturbed
            self._scheme.set_outputs(self._rows, outputs + noise)
            actions = self._scheme.compute_actions(self._rows, observation)
            observation, _, terminated, truncated, _ = self._envs.step(actions)
            for row in np.flatnonzero(terminated | truncated).tolist():
                self._start(row, observation, rng)
        return join_samples(parts)

    def _start(self, row: int, observation: Observation, rng: np.random.Generator) -> None:
        """Start the episode of environment `row`; `observation` (n, ...) has the first observations."""
        self._features.reset(row)
        self._scheme.reset(row)
        name = self._context.object_names[int(observation["object_classes"][row, 0])]
        self._expert.reset(row, int(rng.integers(2**31)), [name])
        self._is_student[row], self._is_closed[row] = self._has_student, False
        self._takeovers[row] = rng.uniform(0.0, self._args.latest_takeover)

    def _ask_expert(self, rows: np.ndarray, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
        """Return the expert's outputs (r, m) in some environments, and whether it opens or closes the gripper (r,)."""
        steps = np.rint(observation["time"][rows, 0].astype(float) / TIME_STEP).astype(int)

        def observe(some: np.ndarray) -> Observation:
            return {key: values[some] for key, values in observation.items()}

        actions, _ = self._expert.act(rows, observe, steps)
        outputs = self._scheme.outputs_from_actions(actions, observe(rows))
        is_closed = outputs[:, -1] > 0.0
        is_change = is_closed != self._is_closed[rows]
        self._is_closed[rows] = is_closed
        return outputs, is_change


def fit(decisions: Decisions, args: Args) -> DenseNetwork:
    """Train a new network from features to the expert's outputs."""
    torch.manual_seed(args.seed)
    inputs, targets = torch.as_tensor(decisions.features), torch.as_tensor(decisions.outputs)
    network = make_mlp(inputs.shape[1], targets.shape[1], args.width)
    updates = max(1, round(args.epochs * len(inputs) / args.batch_size))
    weights = 1.0 + (args.change_weight - 1.0) * torch.as_tensor(decisions.is_change).double()
    batches = torch.multinomial(weights, updates * args.batch_size, replacement=True).split(args.batch_size)

    def compute_loss(outputs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        return nn.functional.smooth_l1_loss(outputs, targets[rows], beta=0.2)

    return fit_network(network, "tanh", inputs, batches, compute_loss, args.learning_rate, args.weight_decay)


def main(args: Args) -> Path:
    args = args.resolve_setup()
    dataset = args.open_dataset()
    expert = parse_policy("receiver", args.expert).resolve(dataset, setup=args.setup)
    mutable_args = ("rounds", "closing_margin", "workers")
    folder = open_run_folder(args.out, args, args.resume, dataset.name, mutable_args, expert_hash=expert.code_hash)
    torch.set_num_threads(1)  # The networks are small, and the other cores simulate.
    period = expert.make(dataset, setup=args.setup).hold_time
    origin = describe_origin("train_receiver_dagger", args, "workers")
    spec = PolicySpec("receiver", args.features, args.action_scheme, period, origin)
    decisions: list[Decisions] = []
    student = None
    for number in range(args.rounds):

        def make_collector(number: int = number, student: DenseNetwork | None = student) -> Callable[[int], Decisions]:
            collector = Collector(args, period)
            return lambda batch: collector.collect(number, batch, student)

        batches = range(args.batches)
        part = folder / f"decisions_{number}"
        decisions += generate_samples(Decisions, part, batches, make_collector, "batches", args.workers)
        policy = folder / f"policy_{number}.npz"
        if not policy.exists():
            write_policy(policy, spec, fit(join_samples(decisions), args))
        student = read_policy(policy, "receiver")[1]
        *others, biases = student.biases
        biases = np.append(biases[:-1], biases[-1] - args.closing_margin)
        write_policy(folder / POLICY, spec, replace(student, biases=(*others, biases)))
        if args.val_scenes:
            label, receiver = f"{number + 1} rounds, giver {args.giver}", f"learned:{folder / POLICY}"
            validate(args, args.val_scenes, args.giver, receiver, label, physics=args.val_physics)
    return folder / POLICY


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
