"""Train giver and receiver together with BenchMARL's MAPPO, whose critics observe the environment's state.

    python experiments/training/train_both_benchmarl.py --dataset synthetic --out runs/benchmarl

The task also works with other algorithms of BenchMARL. The script needs the extra `benchmarl`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from both_agents import PairArgs, make_env, write_pair
from torchrl.envs import EnvBase, PettingZooWrapper
from torchrl.modules import MultiAgentMLP

from handover_marl.envs.agents import AGENTS
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.training.scene_arguments import run_script


class HandoverClass(PettingZooClass):
    """BenchMARL task with two groups of one agent, giver and receiver."""

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], Any]:
        return lambda: PettingZooWrapper(make_env(self.config["args"]), return_state=True, seed=seed, device=device)

    def supports_continuous_actions(self) -> bool:
        return True

    def has_state(self) -> bool:
        return True

    def has_render(self, env: EnvBase) -> bool:
        return False

    @staticmethod
    def env_name() -> str:
        return "handover"


def main(args: PairArgs) -> None:
    torch.set_num_threads(1)
    Path(args.out).mkdir(parents=True, exist_ok=True)
    task = HandoverClass("handover", {"args": args, "max_cycles": args.max_cycles})
    algorithm, model, config = (each.get_from_yaml() for each in (MappoConfig, MlpConfig, ExperimentConfig))
    algorithm.clip_epsilon, algorithm.lmbda = args.clip_range, args.gae_lambda
    algorithm.scale_mapping = f"biased_softplus_{args.initial_std}"
    model.num_cells = [args.width, args.width]
    config.gamma, config.lr, config.clip_grad_val = args.discount, args.learning_rate, 0.5
    config.max_n_frames, config.on_policy_collected_frames_per_batch = args.decisions, args.batch_size
    config.on_policy_n_envs_per_worker, config.parallel_collection = args.num_envs, args.num_envs > 1
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = args.epochs, args.minibatch_size
    config.evaluation, config.render, config.loggers = False, False, ["csv"]
    config.create_json, config.save_folder = False, args.out
    experiment = Experiment(task, algorithm, model, args.seed, config)
    layers: dict[str, MultiAgentMLP] = {}
    for agent in AGENTS:
        policy = experiment.algorithm.get_policy_for_loss(agent)
        (layers[agent],) = [part for part in policy.modules() if isinstance(part, MultiAgentMLP)]
        # First outputs are nearly zero, a sensible action.
        parameters = layers[agent].params
        for tensor in parameters[max(parameters.keys(), key=int)].values():
            tensor.data.mul_(0.01)
    experiment.collector.update_policy_weights_()
    experiment.collector.set_seed(args.seed)  # BenchMARL gives all environments the same seed
    experiment.run()
    sizes = {agent: experiment.action_spec[agent, "action"].shape[-1] for agent in AGENTS}
    nets = {agent: part.get_stateful_net() for agent, part in layers.items()}
    networks = {agent: dense_network_from_layers(net, "tanh", "tanh", sizes[agent]) for agent, net in nets.items()}
    write_pair(networks, args, "train_both_benchmarl")


if __name__ == "__main__":
    run_script(main, PairArgs, __doc__)
