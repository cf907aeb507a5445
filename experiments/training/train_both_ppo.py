"""Train giver and receiver together by PPO in plain PyTorch: IPPO, or MAPPO with `--critic both`.

    python experiments/training/train_both_ppo.py --data-dir DIR --seed 0 --out runs/both0

The giver chooses the pose in which it holds out the object; the receiver corrects the approach to a grasp and chooses
when to close the gripper. Both get the reward of a success. In MAPPO (Yu et al., NeurIPS 2022) the value functions
observe the features of both agents. The folder gets `giver.npz` and `receiver.npz`. Agents of several seeds are
compared with partners that they never met by

    handover-marl crossplay --givers learned:runs/both0/giver.npz learned:runs/both1/giver.npz \
        --receivers learned:runs/both0/receiver.npz learned:runs/both1/receiver.npz --split val
"""

from dataclasses import dataclass
from typing import Any, Literal

from both_agents import FEATURES, SCHEMES, PairArgs, write_pair
from train_ppo import train

from handover_marl.envs.agents import AGENTS
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.training.scene_arguments import run_script


@dataclass(frozen=True)
class Args(PairArgs):
    """Arguments of the training of giver and receiver by PPO.

    Attributes:
        critic: Features that an agent's value function observes: "own", or "both" for the features of both agents.
        workers: Number of processes that simulate the environments; the result depends on it.
    """

    critic: Literal["own", "both"] = "own"
    decisions: int = 1_000_000
    num_envs: int = 128
    workers: int = 2


def main(args: Args) -> None:
    args = args.resolve_setup()
    options: dict[str, Any] = {"features": FEATURES, "action_scheme": SCHEMES, "processes": 1}
    models = train(args, AGENTS, args.workers, sees_both=args.critic == "both", **options)
    networks = {agent: dense_network_from_layers(model.actor, "tanh") for agent, model in models.items()}
    write_pair(networks, args, "train_both_ppo")


if __name__ == "__main__":
    run_script(main, Args, __doc__)
