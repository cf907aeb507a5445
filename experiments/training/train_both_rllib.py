"""Train giver and receiver together with RLlib's PPO on its new API stack, with an RLModule for each agent.

    python experiments/training/train_both_rllib.py --dataset synthetic --out runs/rllib

The script needs the extra `rllib`.
"""

import math
from typing import Any

import ray
import torch
from both_agents import PairArgs, make_env, write_pair
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env
from rich.progress import track
from torch import nn

from handover_marl.envs.agents import AGENTS
from handover_marl.learning.adapters.modules import dense_network_from_layers
from handover_marl.learning.training.run_folder import make_mlp
from handover_marl.learning.training.scene_arguments import run_script


class ActorCritic(TorchRLModule, ValueFunctionAPI):
    """Gaussian policy with a state-independent standard deviation, and a value function."""

    def setup(self) -> None:
        n_inputs, n_outputs = self.observation_space.shape[0], self.action_space.shape[0]
        self.actor = make_mlp(n_inputs, n_outputs, self.model_config["width"], 0.01)
        self.critic = make_mlp(n_inputs, 1, self.model_config["width"])
        self.log_std = nn.Parameter(torch.full((n_outputs,), math.log(self.model_config["initial_std"])))

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        means = self.actor(batch[Columns.OBS])
        return {Columns.ACTION_DIST_INPUTS: torch.cat([means, self.log_std.expand_as(means)], -1)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        values: torch.Tensor = self.critic(batch[Columns.OBS])
        return values.squeeze(-1)


def make_config(args: PairArgs) -> PPOConfig:
    register_env("handover", lambda _: ParallelPettingZooEnv(make_env(args)))
    module = RLModuleSpec(ActorCritic, model_config={"width": args.width, "initial_std": args.initial_std})
    config = PPOConfig().environment("handover").learners(num_learners=0)
    # RLlib discards batches that take longer than the timeout, as they may on a busy machine.
    config.env_runners(num_env_runners=args.num_envs if args.num_envs > 1 else 0, sample_timeout_s=3600.0)
    config.multi_agent(policies=set(AGENTS), policy_mapping_fn=lambda agent, episode, **_: agent)
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=dict.fromkeys(AGENTS, module)))
    config.training(train_batch_size_per_learner=args.batch_size, minibatch_size=args.minibatch_size)
    config.training(num_epochs=args.epochs, lr=args.learning_rate, gamma=args.discount, lambda_=args.gae_lambda)
    config.training(clip_param=args.clip_range, vf_clip_param=float("inf"), vf_loss_coeff=0.5)
    return config.training(use_kl_loss=False, grad_clip=0.5).debugging(seed=args.seed, log_level="ERROR")


def main(args: PairArgs) -> None:
    torch.set_num_threads(1)
    ray.init("local", num_cpus=args.num_envs + 1, include_dashboard=False, log_to_driver=False)
    algorithm = make_config(args).build_algo()
    for _ in track(range(math.ceil(args.decisions / args.batch_size)), description="updates"):
        algorithm.train()
    # The policies' means are used as outputs, not clipped.
    networks = {agent: dense_network_from_layers(algorithm.get_module(agent).actor, "tanh") for agent in AGENTS}
    algorithm.stop()
    ray.shutdown()
    write_pair(networks, args, "train_both_rllib")


if __name__ == "__main__":
    run_script(main, PairArgs, __doc__)
