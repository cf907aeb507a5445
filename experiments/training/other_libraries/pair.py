"""Arguments, environment and policy files of the scripts that train giver and receiver with other libraries."""

from dataclasses import dataclass
from pathlib import Path

import handover_marl
from handover_marl.datasets.splits import select_scenes_evenly
from handover_marl.envs.wrappers.encode import EncodedEnv
from handover_marl.learning.policy_files import write_policy
from handover_marl.learning.policy_spec import DenseNetwork, PolicySpec
from handover_marl.learning.training.run_folder import describe_origin, summarize_evaluation
from handover_marl.learning.training.scene_arguments import RlArgs

#: Names of the features that each agent observes, and of the action scheme that decodes its outputs.
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
    """Make the training environment, in which both agents have feature vectors and scaled outputs, see `encode`."""
    env = handover_marl.parallel_env(
        setup=args.setup,
        split="train",
        dataset=args.dataset,
        data_dir=args.data_dir,
        physics=args.physics,
        control_period=args.control_period,
        max_cycles=args.max_cycles,
    )
    encoded: EncodedEnv = handover_marl.encode(env, FEATURES, SCHEMES)
    return encoded


def write_pair(networks: dict[str, DenseNetwork], args: PairArgs, script: str) -> None:
    """Write the networks of a script as policy files, evaluate them on validation scenes, and print the outcomes."""
    for agent, network in networks.items():
        origin = describe_origin(f"other_libraries/{script}", args)
        path = Path(args.out) / f"{agent}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_policy(path, PolicySpec(agent, FEATURES[agent], SCHEMES[agent], args.control_period, origin), network)
    args = args.resolve_setup()
    giver, receiver = (f"learned:{Path(args.out) / agent}.npz" for agent in ("giver", "receiver"))
    report = handover_marl.evaluate_pair(
        giver,
        receiver,
        args.setup,
        "val",
        scenes=select_scenes_evenly(args.open_dataset().list_scenes(args.setup, "val"), args.val_scenes),
        dataset=args.dataset,
        data_dir=args.data_dir,
        physics=args.physics,
        progress=False,
    )
    print(summarize_evaluation(report, f"{args.decisions} decisions"))
