"""Arguments, environment and policy files of the scripts `train_both_*.py` that train giver and receiver together."""

from dataclasses import dataclass
from pathlib import Path

import handover_marl
from handover_marl.envs.wrappers.encode import EncodedEnv
from handover_marl.learning.policy_files import DenseNetwork, PolicySpec, write_policy
from handover_marl.learning.training.run_folder import describe_origin, validate
from handover_marl.learning.training.scene_arguments import RlArgs

#: For each agent, names of the features that it observes and of the action scheme that decodes its outputs.
FEATURES = {"giver": "giver", "receiver": "close"}
SCHEMES = {"giver": "offer", "receiver": "grasp_servo"}


@dataclass(frozen=True)
class PairArgs(RlArgs):
    """Arguments of the training of giver and receiver by PPO.

    Attributes:
        out: Folder of `giver.npz` and `receiver.npz`.
    """

    out: str = "runs/pair"
    val_scenes: int = 18


def make_env(args: PairArgs) -> EncodedEnv:
    """Make the training environment; by `encode`, both agents observe features and act by scaled outputs."""
    encoded: EncodedEnv = handover_marl.encode(handover_marl.parallel_env(**args.env_options), FEATURES, SCHEMES)
    return encoded


def write_pair(networks: dict[str, DenseNetwork], args: PairArgs, script: str) -> None:
    """Write the networks of a script as policy files, evaluate them on validation scenes, and print the outcomes."""
    for agent, network in networks.items():
        origin = describe_origin(script, args)
        path = Path(args.out) / f"{agent}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_policy(path, PolicySpec(agent, FEATURES[agent], SCHEMES[agent], args.control_period, origin), network)
    args = args.resolve_setup()
    giver, receiver = (f"learned:{Path(args.out) / agent}.npz" for agent in ("giver", "receiver"))
    if args.val_scenes:
        validate(args, args.val_scenes, giver, receiver, f"{args.decisions} decisions", physics=args.physics)
