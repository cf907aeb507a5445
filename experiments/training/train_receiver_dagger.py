r"""Train a receiver to imitate another one by DAgger (Ross, Gordon and Bagnell, AISTATS 2011).

    python experiments/training/train_receiver_ppo.py --data-dir DIR --giver replay --control-period 0.1 \
        --discount 0.95 --decisions 30000 --out runs/servo.npz
    python experiments/training/train_receiver_dagger.py --data-dir DIR --expert learned:runs/servo.npz \
        --out runs/dagger

In each round, the scenes of the training split are played once. In the first round the expert acts, with random
disturbances. In later rounds, the network acts first; the expert takes over at a random time, or when the network
closes the gripper, and shows how to go on from there. Decisions of the expert are recorded. The network is trained anew
after each round. It maps features to the outputs of an action scheme, such as motions of the gripper, without a script.
The folder gets `policy.npz` (`--receiver learned:runs/dagger/policy.npz`), from which `train_receiver_ppo.py --initial`
starts; `--resume` continues a run.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

import handover_marl
from handover_marl.envs.config import EnvConfig
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.features import make_features
from handover_marl.learning.imitation.samples import generate_samples, join_samples
from handover_marl.learning.policy_files import read_policy, write_policy
from handover_marl.learning.policy_spec import DenseNetwork, InputNormalization, PolicySpec
from handover_marl.learning.schemes import make_scheme, outputs_from_action
from handover_marl.learning.training.run_folder import (
    POLICY,
    describe_origin,
    make_mlp,
    open_run_folder,
    print_validation,
    select_training_scenes,
)
from handover_marl.learning.training.scene_arguments import SetupArgs, run_script
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import parse_policy


@dataclass(frozen=True)
class Args(SetupArgs):
    """Arguments of the training of a receiver by imitation.

    Attributes:
        out: Folder of the run.
        seed: Seed of all random numbers.
        expert: Receiver to imitate, whose control period must not change. It should depend on little more than the
            features: a network learns the mean of what an expert does in states with equal features.
        giver: Giver of all episodes. With `replay` alone, networks learn the scenes by heart.
        features: Features of the receiver, inputs of the network.
        actions: Action scheme that decodes the network's outputs; it must be invertible.
        rounds: Number of rounds; each plays every training scene once.
        disturbance: Standard deviation of the disturbances of the outputs that move the arm.
        disturbed_share: Share of the decisions that are disturbed.
        latest_takeover: Largest time at which the expert takes over (s).
        change_weight: Weight of decisions in which the expert opens or closes the gripper, which are few; others have
            the weight 1.
        width: Width of the two hidden layers of the network.
        updates: Number of gradient steps in each training of the network.
        batch_size: Number of decisions per gradient step.
        learning_rate: Learning rate of AdamW at the start; it decays to zero.
        weight_decay: Weight decay of AdamW.
        val_scenes: Number of validation scenes in the evaluation after each round, evenly chosen; 0 skips it.
        val_physics: Physics of the evaluations: fast, exact or mujoco.
        workers: Number of processes, on which the results do not depend; default: one per core.
        resume: Whether to continue the run in the folder `out`.
    """

    out: Path = Path("runs/dagger")
    seed: int = 0
    expert: str = "learned:runs/servo.npz"
    giver: str = "displaced"
    features: str = "grasp_velocity"
    actions: str = "cartesian_delta"
    rounds: int = 6
    disturbance: float = 0.3
    disturbed_share: float = 0.1
    latest_takeover: float = 6.0
    change_weight: float = 20.0
    width: int = 256
    updates: int = 5_000
    batch_size: int = 512
    learning_rate: float = 1e-3
    weight_decay: float = 0.01
    val_scenes: int = 36
    val_physics: str = "mujoco"
    workers: int | None = None
    resume: bool = False


class Decisions(NamedTuple):
    """Decisions of n control periods.

    Attributes:
        features: Features (n, k) of the observations.
        outputs: Outputs (n, m) of the action scheme that are decoded to the expert's actions.
    """

    features: np.ndarray
    outputs: np.ndarray


def make_expert(args: Args) -> Policy:
    """Make the receiver to imitate, which has the robot and the grasps of the training's dataset."""
    return parse_policy("receiver", args.expert).make(args.open_dataset(), setup=args.setup)


def make_player(args: Args, number: int, student: DenseNetwork | None) -> Callable[[int], Decisions]:
    """Return a function that plays the scene with a number and returns the expert's decisions.

    Args:
        args: Arguments of the training.
        number: Number of the round.
        student: Network that acts until the expert takes over; None: the expert always acts.
    """
    expert = make_expert(args)
    config = EnvConfig(
        setup=args.setup,
        split="train",
        data_dir=args.data_dir,
        dataset=args.dataset,
        physics="mujoco",
        control_period=expert.hold_time,
    )
    env = handover_marl.freeze(handover_marl.parallel_env(config), "receiver", args.giver)
    context = env.unwrapped.policy_context
    features = make_features("receiver", args.features, context)
    scheme = make_scheme("receiver", args.actions, context)

    def play(scene: int) -> Decisions:
        rng, inputs, targets = np.random.default_rng((args.seed, number, scene)), [], []
        takeover = 0.0 if student is None else rng.uniform(0.0, args.latest_takeover)
        observations, _ = env.reset(seed=int(rng.integers(2**31)), options={"scene_id": scene})
        features.reset()
        scheme.reset()
        expert.reset(int(rng.integers(2**31)))
        is_student = student is not None
        while env.agents:
            observation = observations["receiver"]
            vector = features(observation)
            if student is not None and is_student:
                outputs = student(vector)
                is_student = outputs[-1] <= 0.0 and observation["time"][0] < takeover
            if not is_student:
                outputs = outputs_from_action(scheme, expert.act(observation), observation)
                inputs.append(vector)
                targets.append(outputs)
            if rng.random() < args.disturbed_share:
                noise = args.disturbance * rng.standard_normal(scheme.size - 1)
                outputs = outputs + np.append(noise, 0.0)  # the gripper is not disturbed
            scheme.set_outputs(outputs)
            observations = env.step({"receiver": scheme.compute_action(observation)})[0]
        return Decisions(
            np.array(inputs, np.float32).reshape(-1, features.size),
            np.array(targets, np.float32).reshape(-1, scheme.size),
        )

    return play


def fit(decisions: Decisions, args: Args) -> DenseNetwork:
    """Train a new network from features to the expert's outputs."""
    torch.manual_seed(args.seed)
    inputs, targets = map(torch.as_tensor, decisions)
    mean, scale = inputs.mean(0), inputs.std(0).clamp(min=0.05)
    inputs = ((inputs - mean) / scale).clamp(-5.0, 5.0)
    network = make_mlp(inputs.shape[1], targets.shape[1], args.width)
    optimizer = torch.optim.AdamW(network.parameters(), args.learning_rate, weight_decay=args.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.updates)
    closes = targets[:, -1] > 0.0
    weights = 1.0 + (args.change_weight - 1.0) * (closes != closes.roll(1)).double()
    for _ in range(args.updates):
        rows = torch.multinomial(weights, args.batch_size, replacement=True)
        loss = nn.functional.smooth_l1_loss(network(inputs[rows]), targets[rows], beta=0.2)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    print(f"{len(inputs)} decisions: loss {loss.item():.4f}", flush=True)
    size = inputs.shape[1]
    normalization = InputNormalization(mean.double().numpy(), scale.double().numpy(), np.full(size, 5.0))
    return replace(dense_network_from_layers(network, "tanh"), normalization=normalization)


def main(args: Args) -> Path:
    args = args.resolve_setup()
    dataset = args.open_dataset()
    folder = open_run_folder(args.out, args, args.resume, dataset.name, ("rounds", "workers"))
    scenes = select_training_scenes(dataset.list_scenes(args.setup, "train"))
    origin = describe_origin("train_receiver_dagger", args)
    spec = PolicySpec("receiver", args.features, args.actions, make_expert(args).hold_time, origin)
    parts: list[Decisions] = []
    student = None
    for number in range(args.rounds):
        title, make = f"round {number}", lambda n=number, s=student: make_player(args, n, s)
        parts += generate_samples(Decisions, folder / f"round_{number}", scenes, make, title, args.workers)
        policy = folder / f"policy_{number}.npz"
        if not policy.exists():
            write_policy(policy, spec, fit(join_samples(parts), args))
        student = read_policy(policy, "receiver")[1]
        write_policy(folder / POLICY, spec, student)
        label = f"{number + 1} rounds, giver {args.giver}"
        print_validation(args, args.val_scenes, args.val_physics, args.giver, f"learned:{policy}", label)
    return folder / POLICY


if __name__ == "__main__":
    print(run_script(main, Args, __doc__))
