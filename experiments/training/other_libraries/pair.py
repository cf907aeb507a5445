"""Arguments, environment and policy files of the scripts that train giver and receiver with other libraries."""

import math
from dataclasses import dataclass
from pathlib import Path

import handover_marl
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.envs.wrappers.encode import EncodedEnv
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from handover_marl.learning.training.run_folder import describe_origin, summarize_evaluation
from handover_marl.learning.training.scene_arguments import SetupArgs

#: Names of the features that each agent observes, and of the action scheme that decodes its outputs.
FEATURES = {"giver": "giver", "receiver": "close"}
SCHEMES = {"giver": "offer", "receiver": "grasp_servo"}


@dataclass(frozen=True)
class PairArgs(SetupArgs):
    """Arguments of the training of giver and receiver by PPO.

    Attributes:
        out: Folder of `giver.npz` and `receiver.npz`.
        seed: Seed of all random numbers.
        physics: Simulation: fast, exact, or mujoco.
        num_envs: Number of environments simulated in parallel.
        decisions: Number of decisions of each agent.
        batch_size: Number of decisions in all environments together between updates.
        minibatch_size: Number of decisions per gradient step.
        epochs: Number of passes over the collected data between updates.
        learning_rate: Learning rate of Adam.
        discount: Discount factor. With 0.97 the mean of a pair never learns to close the gripper; exploration noise
            closes it late enough.
        gae_lambda: Lambda of generalized advantage estimation.
        clip_range: Largest deviation from 1 of the probability ratio in PPO's objective.
        width: Width of the two hidden layers of each network.
        initial_std: Initial standard deviation of the network outputs, for exploration.
        control_period: Time between two decisions (s).
        time_limit: Time after which training episodes are truncated (s).
        val_scenes: Number of validation scenes of the final evaluation, evenly chosen.
    """

    out: str = "runs/pair"
    seed: int = 0
    physics: str = "mujoco"
    num_envs: int = 2
    decisions: int = 49_152
    batch_size: int = 2_048
    minibatch_size: int = 128
    epochs: int = 8
    learning_rate: float = 1e-3
    discount: float = 0.85
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    width: int = 128
    initial_std: float = 0.4
    control_period: float = 0.2
    time_limit: float = 8.0
    val_scenes: int = 18


def make_env(args: PairArgs) -> EncodedEnv:
    """Make the training environment, whose observations and actions are vectors."""
    env = handover_marl.parallel_env(
        setup=args.setup,
        split="train",
        dataset=args.dataset,
        data_dir=args.data_dir,
        physics=args.physics,
        control_period=args.control_period,
        max_cycles=math.ceil(args.time_limit / args.control_period),
    )
    encoded: EncodedEnv = handover_marl.encode(env, FEATURES, SCHEMES)
    return encoded


def write_pair(networks: dict[str, DenseNetwork], args: PairArgs, script: str) -> None:
    """Write both policies, evaluate them together on the validation split, and print the outcomes."""
    for agent, network in networks.items():
        origin = describe_origin(f"other_libraries/{script}", args)
        path = Path(args.out) / f"{agent}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_policy(path, PolicySpec(agent, FEATURES[agent], SCHEMES[agent], args.control_period, origin), network)
    data = args.open_dataset()
    setup = data.resolve_setup(args.setup)
    giver, receiver = (f"learned:{Path(args.out) / agent}.npz" for agent in ("giver", "receiver"))
    report = handover_marl.evaluate_pair(
        giver,
        receiver,
        setup,
        "val",
        scenes=select_scenes_evenly(data.list_scenes(setup, "val"), args.val_scenes),
        dataset=args.dataset,
        data_dir=args.data_dir,
        physics=args.physics,
        progress=False,
    )
    print(summarize_evaluation(report, f"{args.decisions} decisions"))
