"""Train giver and receiver together with RLlib's PPO on its new API stack.

The script needs the extras `rllib` and `plot`, and by default MuJoCo; `--physics fast` does not need it, but
is slower.

    python experiments/training/other_libraries/train_both_rllib.py --dataset synthetic --out runs/rllib

Each agent has an RLModule of its own, because the spaces differ; EnvRunners run in processes, with
the default connectors. RLModules need vectors. This script makes them with `encode`;
`handover_marl.flatten` converts complete observations to vectors. The folder gets `giver.npz` and
`receiver.npz`, which need no Ray, and a learning curve.
"""

import math
from dataclasses import dataclass
from typing import Any

import ray
import torch
import tyro
from ray.rllib.algorithms.algorithm import Algorithm
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

from handover_marl.envs.arguments import AGENTS
from handover_marl.envs.wrappers.episode_returns import RETURN_PREFIX
from handover_marl.learning.adapters.torch_modules import dense_network_from_module
from handover_marl.learning.policy_spec import DenseNetwork
from handover_marl.learning.training.arguments import PairArgs
from handover_marl.learning.training.dense_networks import make_mlp
from handover_marl.learning.training.environments import make_pair_env
from handover_marl.learning.training.reward_curve import RewardCurve
from handover_marl.learning.training.training_run import TrainingRun

_TERMS = "reward_terms"
_OBJECT_STORE = 200_000_000  # bytes
_SAMPLE_TIMEOUT = 3600.0  # s


@dataclass(frozen=True)
class Args(PairArgs):
    """Arguments of the training with RLlib; with several environments each has its own process."""

    out: str = "runs/rllib"


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


def log_reward_terms(episode: Any, metrics_logger: Any, **kwargs: Any) -> None:
    """Log the sums of the reward terms of a finished episode, for `add_reward_terms`."""
    for agent in AGENTS:
        for key, value in (episode.agent_episodes[agent].get_infos(-1) or {}).items():
            if key.startswith(RETURN_PREFIX):
                metrics_logger.log_value((_TERMS, agent, key), value, reduce="item_series")


def add_reward_terms(rewards: RewardCurve, result: dict[str, Any], decisions: int) -> None:
    """Add the logged episodes of a training iteration to the curve of the reward terms."""
    for agent, terms in result.get("env_runners", {}).get(_TERMS, {}).items():
        for values in zip(*terms.values(), strict=True):
            rewards.add_episode(agent, dict(zip(terms, values, strict=True)))
    rewards.write_point(decisions)


def make_config(args: Args) -> PPOConfig:
    register_env("handover", lambda _: ParallelPettingZooEnv(make_pair_env(args)))
    module = RLModuleSpec(ActorCritic, model_config={"width": args.width, "initial_std": args.initial_std})
    return (
        PPOConfig()
        .environment("handover")
        # RLlib discards batches that take longer, as they do on a busy machine.
        .env_runners(num_env_runners=args.num_envs if args.num_envs > 1 else 0, sample_timeout_s=_SAMPLE_TIMEOUT)
        .callbacks(on_episode_end=log_reward_terms)
        .learners(num_learners=0)
        .multi_agent(policies=set(AGENTS), policy_mapping_fn=lambda agent, episode, **_: agent)
        .rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=dict.fromkeys(AGENTS, module)))
        .training(
            train_batch_size_per_learner=args.batch_size,
            minibatch_size=args.minibatch_size,
            num_epochs=args.epochs,
            vf_loss_coeff=0.5,
            lr=args.learning_rate,
            gamma=args.discount,
            lambda_=args.gae_lambda,
            clip_param=args.clip_range,
            vf_clip_param=float("inf"),
            use_kl_loss=False,
            grad_clip=0.5,
        )
        .debugging(seed=args.seed, log_level="ERROR")
    )


def extract_policy_networks(algorithm: Algorithm) -> dict[str, DenseNetwork]:
    """Return the network of each agent's mean actions, which are not clipped, by agent."""
    return {agent: dense_network_from_module(algorithm.get_module(agent).actor, "tanh") for agent in AGENTS}


def main(args: Args) -> TrainingRun:
    args = args.shrink_for_smoke_test()
    torch.set_num_threads(1)
    run = TrainingRun(args, "other_libraries/train_both_rllib", args.encodings)
    ray.init(
        num_cpus=args.num_envs + 1, object_store_memory=_OBJECT_STORE, include_dashboard=False, log_to_driver=False
    )
    try:
        algorithm = make_config(args).build_algo()
        run.evaluate(0, extract_policy_networks(algorithm))
        for _ in track(range(math.ceil(args.decisions / args.batch_size)), description="updates"):
            result = algorithm.train()
            decisions = int(result["num_env_steps_sampled_lifetime"])
            returns = result.get("env_runners", {}).get("agent_episode_returns_mean", {})
            print(f"{decisions} decisions, mean returns {returns}", flush=True)
            add_reward_terms(run.rewards, result, decisions)
            if run.evaluate_if_due(decisions, lambda: extract_policy_networks(algorithm)):
                break
        algorithm.stop()
    finally:
        ray.shutdown()
    return run


if __name__ == "__main__":
    print(main(tyro.cli(Args)).folder.path)
